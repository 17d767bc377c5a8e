"""F02: a reply arrives later than time-out and quarantine together."""

from __future__ import annotations

import logging
from itertools import combinations

import pytest

from gateway.devices.model import Space
from gateway.devices.plan import poll_plan
from gateway.errors import ReplyTimeout
from gateway.simulator.chaos import Fault
from tests.faults.rig import MakeRig, Rig, oracle_map, read


def miss(line: Rig, late_s: float) -> None:
    line.chaos.force(Fault.LATE, for_s=late_s)
    assert isinstance(line.ask(0, read(0)), ReplyTimeout)


def window_s(line: Rig) -> float:
    return line.engine._wire.quarantine_s(line.now)


def test_the_polled_blocks_of_a_device_have_unequal_lengths() -> None:
    blocks = [block for block in poll_plan(oracle_map()) if block.space is Space.REGISTERS]
    assert all(one.count != other.count for one, other in combinations(blocks, 2))


@pytest.mark.parametrize("late_s", [0.65, 0.7, 0.75, 1.0, 3.0, 9.0])
def test_it_never_answers_the_next_request_of_its_length(rig: MakeRig, late_s: float) -> None:
    line = rig(retries=0)
    miss(line, late_s)
    for first in range(10, 60, 2):
        line.ask(0, read(first))
    wire = line.engine.stats.wire
    line.run(20.0)
    assert wire.late_bytes + 9 * wire.mismatch >= 9
    if late_s < 2.0:  # over that the device is quarantined before its reply comes
        assert line.outcomes["reply"] >= 23
    line.run(60.0)
    assert isinstance(line.ask(0, read(0x20, 2)), bytes)


def test_one_that_comes_while_another_question_is_out_is_a_mismatch(rig: MakeRig) -> None:
    line = rig(retries=0)
    miss(line, 0.66)
    assert isinstance(line.ask(0, read(10)), bytes)
    assert line.engine.stats.wire.mismatch == 1


def test_two_within_a_minute_double_the_window_up_to_two_seconds_with_one_warning_each(
    rig: MakeRig, caplog: pytest.LogCaptureFixture
) -> None:
    line = rig(retries=0)
    widths = [window_s(line)]
    for _ in range(14):
        miss(line, window_s(line) + 0.7)
        line.run(3.5)
        widths.append(round(window_s(line), 3))
        line.ask(0, read(20))
    assert widths == [0.1, 0.1, 0.2, 0.2, 0.4, 0.4, 0.8, 0.8, 1.6, 1.6, 2.0, 2.0, 2.0, 2.0, 2.0]
    warnings = [record for record in caplog.records if "event=late_replies " in record.getMessage()]
    assert [record.levelno for record in warnings] == [logging.WARNING] * 5
    assert "line=line quarantine_s=0.2" in warnings[0].getMessage()


@pytest.mark.parametrize("gap_s", [0.0, 0.2])
def test_the_window_shrinks_again_and_says_so_once(
    rig: MakeRig, caplog: pytest.LogCaptureFixture, gap_s: float
) -> None:
    caplog.set_level(logging.INFO)
    line = rig(retries=0, gap_s=gap_s)
    calm_s = max(0.1, gap_s)
    for _ in range(2):
        miss(line, 0.9)
        line.run(3.0)
    assert window_s(line) == pytest.approx(2 * calm_s)
    line.ask(0, read(0))
    for _ in range(20):
        line.run(10.0)
        line.ask(0, read(0))
    assert window_s(line) == pytest.approx(calm_s)
    assert caplog.text.count("event=late_replies_over") == 1


def test_two_more_than_a_minute_apart_change_nothing(rig: MakeRig) -> None:
    line = rig(retries=0)
    for _ in range(4):
        miss(line, 0.9)
        line.run(61.0)
        line.ask(0, read(0))
    assert window_s(line) == pytest.approx(0.1)
