"""What a device refuses is left out, and is asked for again: no refusal is for ever."""

from __future__ import annotations

import logging

import pytest

from gateway.core.settings import PollSettings
from gateway.core.snapshot import DeviceState
from tests.core.test_engine import Registers, registers, state
from tests.core.test_guard import MANY, forgetful
from tests.core.virtual_line import MakeLine, VirtualLine

SELDOM = PollSettings(live_s=5.0, settings_s=300.0)


def addresses(line: VirtualLine) -> set[int]:
    """The registers that the snapshot holds."""
    blocks = [block for block in line.devices[0].snapshot.blocks if block.space == "registers"]
    return {address for block in blocks for address in range(block.first, block.first + block.count)}


def shapes(line: VirtualLine) -> set[tuple[str, int, int]]:
    return {(block.space, block.first, block.count) for block in line.devices[0].snapshot.blocks}


@pytest.mark.parametrize("code", [2, 3])
@pytest.mark.parametrize(("refusing_s", "within_s"), [(0.1, 610.0), (3.0, 610.0), (12.0, 70.0), (2000.0, 70.0)])
def test_a_device_that_refused_everything_for_a_while_is_read_as_before(
    virtual_line: MakeLine, code: int, refusing_s: float, within_s: float
) -> None:
    device = Registers(1)
    line = virtual_line(device, poll=SELDOM)
    line.run(20.0)
    assert state(line) is DeviceState.ONLINE
    whole = shapes(line)
    device.exception = code
    line.run(refusing_s)
    device.exception = None
    line.run(within_s)
    assert state(line) is DeviceState.ONLINE
    line.run(20.0)
    assert {at for _, first, count in whole for at in range(first, first + count)} <= addresses(line) | {0, 1, 2}
    if refusing_s > 1.0:  # one refusal alone is remembered as a limit of the device
        assert shapes(line) == whole


def test_a_device_that_refuses_all_live_values_is_not_online_and_costs_the_line_little(
    virtual_line: MakeLine,
) -> None:
    device = Registers(1)
    line = virtual_line(device, poll=SELDOM)
    line.run(20.0)
    device.exception = 2
    line.run(20.0)
    assert state(line) is DeviceState.STALE
    assert not line.devices[0].snapshot.shown()
    busy_s, sent = line.engine.stats.busy_s, line.engine.stats.sent
    line.run(3600.0)
    assert state(line) is DeviceState.STALE
    assert line.engine.stats.busy_s - busy_s < 0.02 * 3600
    assert line.engine.stats.sent - sent >= 55, "it is asked every minute"
    device.exception = None
    line.run(70.0)
    assert state(line) is DeviceState.ONLINE


def test_what_a_device_never_has_is_asked_for_every_ten_minutes_and_said_once(
    virtual_line: MakeLine, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    device = Registers(1)
    device.refused = {0x04}
    line = virtual_line(device, poll=SELDOM)
    line.run(30.0)
    assert state(line) is DeviceState.ONLINE
    device.asked.clear()
    line.run(6000.0)
    assert state(line) is DeviceState.ONLINE
    assert 9 <= device.asked.count(registers(0x04, 1)) <= 11
    assert caplog.text.count("action=dropped") == 1
    assert 0x12 in addresses(line)


def test_what_a_device_has_after_all_is_read_with_the_rest_in_one(virtual_line: MakeLine) -> None:
    device = Registers(1)
    line = virtual_line(device, poll=SELDOM)
    line.run(20.0)
    whole = shapes(line)
    device.refused = {0x04}
    line.run(30.0)
    assert shapes(line) != whole
    device.refused = set()
    line.run(700.0)
    assert shapes(line) == whole


def test_how_often_live_values_are_refreshed_is_told_of_those_that_are_read(virtual_line: MakeLine) -> None:
    device = Registers(1)
    device.refused = {0x00}
    line = virtual_line(device)
    line.run(1300.0)
    refresh_s = line.devices[0].stats.refresh_s
    assert refresh_s is not None
    assert refresh_s < 2.0


SETTINGS = b"\x03\xe0\x00"


@pytest.mark.parametrize("code", [0, 0x04, 0x06], ids=["lost", "04", "06"])
def test_settings_that_did_not_come_are_asked_for_again_soon(virtual_line: MakeLine, code: int) -> None:
    line = virtual_line(forgetful(SETTINGS, 2, code))
    line.run(5.0)
    assert state(line) is DeviceState.ONLINE
    assert 0xE000 not in addresses(line)
    line.run(35.0)
    assert 0xE000 in addresses(line)


def test_settings_that_never_come_cost_the_line_little(virtual_line: MakeLine) -> None:
    line = virtual_line(forgetful(SETTINGS, MANY, 0x04))
    line.run(3600.0)
    assert 12 <= sum(frame[1:].startswith(SETTINGS) for _, frame in line.sent) <= 20
