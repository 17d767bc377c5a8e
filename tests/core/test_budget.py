"""The projection that check-config prints agrees with the wire."""

from __future__ import annotations

import itertools

import pytest

from gateway.core.budget import TURNAROUND_S, line_budget, read_s
from gateway.core.settings import LineSettings, PollSettings
from gateway.core.site import Outcome
from gateway.devices.model import Space
from gateway.devices.schema import load_map
from gateway.errors import ReplyTimeout
from gateway.modbus.pdu import Function, ReadRequest
from gateway.modbus.rtu_wire import RtuWire
from tests.core.test_engine import Registers
from tests.core.virtual_line import MakeLine

PROSTAR = load_map("prostar-mppt")


def settings(**changes: object) -> LineSettings:
    return LineSettings(name="line", index=1, port="/dev/null", **changes)  # type: ignore[arg-type]  # the tests' own calls


def test_82_registers_take_211_ms_of_wire_at_9600_8n2() -> None:
    timing = settings().timing()
    assert read_s(timing, Space.REGISTERS, 82) - TURNAROUND_S == pytest.approx(0.2108, abs=0.0005)


def test_use_grows_with_devices_and_falls_with_the_period() -> None:
    one = line_budget(settings(), [PROSTAR]).use_ratio
    three = line_budget(settings(), [PROSTAR] * 3).use_ratio
    slow = line_budget(settings(poll=PollSettings(live_s=10.0)), [PROSTAR]).use_ratio
    assert one is not None
    assert three is not None
    assert three == pytest.approx(3 * one)
    assert slow == pytest.approx(one / 10, rel=0.05)


def test_a_line_asked_for_too_much_stretches_all_periods() -> None:
    budget = line_budget(settings(), [PROSTAR] * 10)
    assert budget.use_ratio is not None
    assert budget.use_ratio > 1
    assert budget.live_refresh_s == pytest.approx(budget.use_ratio)


@pytest.mark.parametrize("devices", [1, 3, 8])
def test_the_projection_is_what_the_engine_reaches(virtual_line: MakeLine, devices: int) -> None:
    line = virtual_line(*(Registers(address, turnaround_s=TURNAROUND_S) for address in range(1, devices + 1)))
    line.run(30.0)
    line.sent.clear()
    line.run(120.0)
    budget = line_budget(line.engine.settings, [PROSTAR] * devices)
    reads = [at for at, frame in line.sent if frame[0] == 1 and frame[5] == 82]
    mean_s = (reads[-1] - reads[0]) / (len(reads) - 1)
    assert mean_s == pytest.approx(budget.live_refresh_s, rel=0.06)


@pytest.mark.parametrize("stragglers", [0, 20])
def test_every_read_ends_within_the_printed_deadline(virtual_line: MakeLine, stragglers: int) -> None:
    """The worst that a line can do: every device silent, the queue full, every attempt a time-out.

    Late replies have widened the quarantine as far as it goes.
    """
    dead = [Registers(address) for address in range(1, 9)]
    for controller in dead:
        controller.silent = True
    line = virtual_line(*dead, retries=2, queue_limit=64)
    for _ in range(stragglers):
        assert isinstance(line.engine._wire, RtuWire)
        line.engine._wire.client._window.straggler(line.now)
    assert line.engine._wire.quarantine_s(line.now) == (2.0 if stragglers else 0.1)
    ended: list[tuple[float, Outcome]] = []

    def done(outcome: Outcome) -> None:
        ended.append((line.now, outcome))

    for device, address in itertools.product(line.devices, range(8)):
        request = ReadRequest(Function.READ_HOLDING_REGISTERS, address, 125).encode()
        line.read(device, request, done)
    begin = line.now
    line.run(60.0)
    assert len(ended) == 64
    assert stragglers or any(isinstance(outcome, ReplyTimeout) for _, outcome in ended)
    assert max(at for at, _ in ended) - begin <= line_budget(line.engine.settings, []).reply_deadline_s
