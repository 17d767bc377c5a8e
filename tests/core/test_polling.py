"""What is polled, and what the replies say: identity, night, stretch, and values that must be rewritten."""

from __future__ import annotations

import itertools
import logging

import pytest

from gateway.core.identity import Identity
from gateway.core.settings import PollSettings
from gateway.core.site import Outcome
from gateway.core.snapshot import IDENTITY_MISMATCH, NOT_REWRITTEN, DeviceState
from gateway.devices.schema import load_map
from gateway.errors import EchoUnknown, IdentityUnproven, IllegalFunction, ReplyTimeout
from gateway.modbus.pdu import Function, ReadRequest
from gateway.simulator.device import SimulatedController
from tests.core.virtual_line import MakeLine, VirtualLine

MAP = load_map("prostar-mppt")
SLAVE_VOLTAGE = MAP.point("battery_target_voltage_slave").address


def controller(address: int = 1, **options: object) -> SimulatedController:
    return SimulatedController(MAP, address=address, **options)  # type: ignore[arg-type]  # the tests' own calls


def state(line: VirtualLine, index: int = 0) -> DeviceState:
    return line.devices[index].snapshot.state


def live_reads(line: VirtualLine, address: int = 1) -> list[float]:
    request = ReadRequest(Function.READ_HOLDING_REGISTERS, 0, 82).encode()
    return [at for at, frame in line.sent if frame[0] == address and frame[1:6] == request]


def write(line: VirtualLine, register: int, value: int, wait_s: float = 3.0) -> Outcome:
    outcomes: list[Outcome] = []
    pdu = bytes((Function.WRITE_SINGLE_REGISTER,)) + register.to_bytes(2, "big") + value.to_bytes(2, "big")
    line.write(line.devices[0], pdu, outcomes.append)
    line.run(wait_s)
    assert len(outcomes) == 1
    return outcomes[0]


def reopen(line: VirtualLine, away_s: float = 1.0) -> None:
    line.engine.closed("unplugged", line.now)
    line.run(away_s)
    line.wire.clear()
    line.engine.opened(line.now)


def test_a_simulated_controller_is_identified_and_shown(virtual_line: MakeLine) -> None:
    line = virtual_line(controller())
    line.run(3.0)
    snapshot = line.devices[0].snapshot
    assert state(line) is DeviceState.ONLINE
    assert snapshot.identification is not None
    assert snapshot.identification.product.startswith("PS-MPPT-")
    assert snapshot.shown()["battery_voltage"] > 10


def test_the_same_controller_is_online_again_after_the_adapter_was_replugged(virtual_line: MakeLine) -> None:
    line = virtual_line(controller())
    line.run(3.0)
    reopen(line, away_s=600.0)
    line.run(2.0)
    assert state(line) is DeviceState.ONLINE
    assert not line.devices[0].snapshot.warnings


def test_two_swapped_adapters_never_serve_each_others_controller(
    virtual_line: MakeLine, caplog: pytest.LogCaptureFixture
) -> None:
    mine, other = controller(seed=1), controller(seed=2)
    assert mine.handle(b"\x03\0\x36\0\2", 0.0) != other.handle(b"\x03\0\x36\0\2", 0.0)
    line = virtual_line(mine)
    line.run(3.0)
    line.wire.stations[:] = [other]
    reopen(line)
    outcomes: list[Outcome] = []
    for _ in range(20):
        line.read(line.devices[0], ReadRequest(Function.READ_HOLDING_REGISTERS, 0x12, 1).encode(), outcomes.append)
        line.run(0.5)
        assert state(line) is not DeviceState.ONLINE
        assert not line.devices[0].snapshot.shown()
    assert {type(outcome) for outcome in outcomes} == {IdentityUnproven}
    assert IDENTITY_MISMATCH in line.devices[0].snapshot.warnings
    assert line.devices[0].stats.identity_mismatches == 1
    assert caplog.text.count("event=identity_mismatch") == 1
    line.wire.stations[:] = [mine]
    reopen(line)
    line.run(3.0)
    assert state(line) is DeviceState.ONLINE
    assert not line.devices[0].snapshot.warnings


def test_a_unit_that_is_not_the_configured_one_is_never_shown(virtual_line: MakeLine) -> None:
    line = virtual_line(controller(), opened=False, expected=Identity(product="PS-MPPT-99"))
    line.engine.opened(line.now)
    line.run(5.0)
    assert state(line) is DeviceState.UNKNOWN
    assert IDENTITY_MISMATCH in line.devices[0].snapshot.warnings


def test_a_foreign_unit_is_looked_at_only_once_a_minute(virtual_line: MakeLine) -> None:
    line = virtual_line(controller(), expected=Identity(product="PS-MPPT-99"))
    line.run(5.0)
    line.sent.clear()
    line.run(300.0)
    assert 4 <= len(live_reads(line)) <= 6


def test_by_night_live_values_are_read_more_seldom_where_that_is_configured(virtual_line: MakeLine) -> None:
    sleeper = controller(start_hour=0.0)
    line = virtual_line(sleeper, poll=PollSettings(live_s=1.0, night_s=20.0))
    line.run(60.0)
    values = line.devices[0].snapshot.values
    assert MAP.night is not None
    assert values["charge_state"] == MAP.night.value
    line.sent.clear()
    line.run(200.0)
    assert 9 <= len(live_reads(line)) <= 11


def test_a_line_that_is_asked_for_too_much_says_by_how_much_periods_stretch(virtual_line: MakeLine) -> None:
    line = virtual_line(*(controller(address) for address in range(1, 9)))
    line.run(60.0)
    line.sent.clear()
    line.run(60.0)
    stretch = line.engine.status(line.now).stretch
    periods = [b - a for address in range(1, 9) for a, b in itertools.pairwise(live_reads(line, address))]
    assert stretch == pytest.approx(sum(periods) / len(periods), rel=0.05)
    assert stretch > 1.8
    assert max(periods) < 1.2 * min(periods)


def test_a_line_with_room_does_not_stretch(virtual_line: MakeLine) -> None:
    line = virtual_line(controller())
    line.run(60.0)
    assert line.engine.status(line.now).stretch < 1.05


def test_a_line_that_allows_no_writes_sends_none(virtual_line: MakeLine) -> None:
    line = virtual_line(controller())
    line.run(3.0)
    assert isinstance(write(line, SLAVE_VOLTAGE, 0), IllegalFunction)
    assert {frame[1] for _, frame in line.sent} <= {1, 2, 3, 4, 0x2B}


def test_no_write_goes_out_before_it_is_known_whether_the_line_echoes(virtual_line: MakeLine) -> None:
    line = virtual_line(controller(), opened=False, writes=True)
    line.engine.opened(line.now)
    assert isinstance(write(line, SLAVE_VOLTAGE, 0, wait_s=0.01), EchoUnknown)


def test_a_written_setting_is_read_back_at_once(virtual_line: MakeLine) -> None:
    line = virtual_line(controller(), writes=True)
    line.run(5.0)
    register = 0xE000
    outcome = write(line, register, 0x4B00)
    assert outcome == bytes((6,)) + register.to_bytes(2, "big") + b"\x4b\x00"
    block = next(
        block for block in line.devices[0].snapshot.blocks if block.first <= register < block.first + block.count
    )
    offset = 2 * (register - block.first)
    assert block.data[offset : offset + 2] == b"\x4b\x00"
    assert sum(1 for _, frame in line.sent if frame[1] == 6) == 1


def test_a_write_without_an_answer_is_never_repeated(virtual_line: MakeLine) -> None:
    unit = controller()
    line = virtual_line(unit, writes=True)
    line.run(5.0)
    unit.silent = True
    assert isinstance(write(line, 0xE000, 0x4B00), ReplyTimeout)
    unit.silent = False
    line.run(30.0)
    assert sum(1 for _, frame in line.sent if frame[1] == 6) == 1


def test_the_missing_answer_to_a_restart_is_success_and_its_silence_no_failure(
    virtual_line: MakeLine, caplog: pytest.LogCaptureFixture
) -> None:
    line = virtual_line(controller(), writes=True)
    line.run(5.0)
    caplog.set_level(logging.INFO)
    caplog.clear()
    outcomes: list[Outcome] = []
    pdu = bytes((5,)) + MAP.point("reset_control").address.to_bytes(2, "big") + b"\xff\x00"
    line.write(line.devices[0], pdu, outcomes.append)
    line.run(12.0)
    assert outcomes == [pdu]
    assert "device_offline" not in caplog.text
    assert state(line) is DeviceState.ONLINE


def test_a_slave_voltage_that_is_not_rewritten_is_warned_about_and_never_rewritten_by_us(
    virtual_line: MakeLine,
) -> None:
    line = virtual_line(controller(), writes=True)
    line.run(5.0)
    assert isinstance(write(line, SLAVE_VOLTAGE, 0x4B00), bytes)
    line.run(30.0)
    assert NOT_REWRITTEN not in line.devices[0].snapshot.warnings
    line.run(13.0)
    assert NOT_REWRITTEN in line.devices[0].snapshot.warnings
    assert isinstance(write(line, SLAVE_VOLTAGE, 0x4B00), bytes)
    assert NOT_REWRITTEN not in line.devices[0].snapshot.warnings
    line.run(60.0)
    assert NOT_REWRITTEN in line.devices[0].snapshot.warnings
    assert isinstance(write(line, SLAVE_VOLTAGE, 0), bytes)
    line.run(120.0)
    assert NOT_REWRITTEN not in line.devices[0].snapshot.warnings
    assert sum(1 for _, frame in line.sent if frame[1] == 6) == 3
