"""F23: the device answers with exception 05 (acknowledge) or 06 (busy)."""

from __future__ import annotations

from pathlib import Path

import pytest

from gateway.core.settings import PollSettings
from gateway.core.site import Outcome
from gateway.core.snapshot import DeviceState
from tests.faults.pty_rig import running
from tests.faults.rig import MakeRig, read


def test_06_is_tried_once_more_and_the_second_answer_counts(rig: MakeRig) -> None:
    line = rig()
    line.units[0].asked.clear()
    line.units[0].exceptions.append(0x06)
    reply = line.ask(0, read(0, 4))
    assert isinstance(reply, bytes)
    assert reply[0] == 0x03
    assert line.units[0].asked == [read(0, 4)] * 2


def test_a_second_06_is_the_answer(rig: MakeRig) -> None:
    line = rig(retries=3)
    line.units[0].asked.clear()
    line.units[0].exceptions.extend((0x06, 0x06, 0x06))
    assert line.ask(0, read(0, 4)) == b"\x83\x06"
    assert len(line.units[0].asked) == 2


def test_without_retries_the_first_06_is_the_answer(rig: MakeRig) -> None:
    line = rig(retries=0)
    line.units[0].exceptions.append(0x06)
    assert line.ask(0, read(0, 4)) == b"\x83\x06"


@pytest.mark.parametrize("code", [0x01, 0x02, 0x03, 0x04, 0x05, 0x08, 0x0A, 0x0B])
def test_every_other_exception_is_the_answer_at_once(rig: MakeRig, code: int) -> None:
    line = rig(retries=3)
    line.units[0].asked.clear()
    line.units[0].exceptions.append(code)
    assert line.ask(0, read(0, 4)) == bytes((0x83, code))
    assert len(line.units[0].asked) == 1


def test_a_write_that_the_device_is_too_busy_for_is_not_repeated(rig: MakeRig) -> None:
    line = rig(writes=True)
    line.units[0].exceptions.append(0x06)
    assert line.write(0, bytes.fromhex("06 E000 0001")) == b"\x86\x06"
    assert [pdu for pdu in line.units[0].asked if pdu[0] == 6] == [bytes.fromhex("06 E000 0001")]


def test_joined_reads_that_meet_a_busy_device_get_an_answer_each(rig: MakeRig) -> None:
    line = rig()
    line.read(0, read(0x8000, 100))  # keeps the line busy, so that the next two are joined
    line.run(0.01)
    outcomes: list[Outcome] = []
    line.read(0, read(0, 4), outcomes.append, client="a")
    line.read(0, read(6, 4), outcomes.append, client="b")
    line.units[0].exceptions.extend((0x06, 0x06))
    line.run(3.0)
    assert len(outcomes) == 2
    assert all(isinstance(outcome, bytes) and outcome[0] == 0x03 for outcome in outcomes)


def test_a_device_that_is_busy_now_and_then_stays_online(rig: MakeRig) -> None:
    line = rig(poll=PollSettings(live_s=1.0))
    for _ in range(20):
        line.units[0].exceptions.append(0x06)
        line.run(3.0)
        assert line.state() is DeviceState.ONLINE


async def test_over_a_pty(tmp_path: Path) -> None:
    async with running(tmp_path) as line:
        await line.online()
        line.units[0].exceptions.append(0x06)
        reply = await line.ask(0, read(0, 4))
        assert isinstance(reply, bytes)
        assert reply[0] == 0x03
        line.units[0].exceptions.append(0x05)
        assert await line.ask(0, read(0, 4)) == b"\x83\x05"
