"""The identity guard at work: nothing of a unit that has not proved to be the expected one is shown or asked for."""

from __future__ import annotations

from gateway.core.identity import Identity
from gateway.core.site import Outcome
from gateway.core.snapshot import IDENTITY_MISMATCH, DeviceState
from gateway.devices.schema import load_map
from gateway.errors import IdentityUnproven
from gateway.modbus.pdu import Function, ReadRequest
from gateway.simulator.device import SimulatedController
from tests.core.virtual_line import MakeLine, VirtualLine

MAP = load_map("prostar-mppt")
BATTERY_VOLTAGE = ReadRequest(Function.READ_HOLDING_REGISTERS, 0x12, 1).encode()
MINE, OTHERS = "17150342", "17150343"


def state(line: VirtualLine) -> DeviceState:
    return line.devices[0].snapshot.state


def mismatch(line: VirtualLine) -> bool:
    return IDENTITY_MISMATCH in line.devices[0].snapshot.warnings


def test_nobody_reads_a_unit_before_it_told_the_configured_serial_number(virtual_line: MakeLine) -> None:
    line = virtual_line(SimulatedController(MAP, serial_number=OTHERS), expected=Identity(serial_number=MINE))
    outcomes: list[Outcome] = []
    for _ in range(10):
        line.read(line.devices[0], BATTERY_VOLTAGE, outcomes.append)
        line.run(0.2)
    assert mismatch(line)
    assert {type(outcome) for outcome in outcomes} == {IdentityUnproven}


def test_nobody_has_to_wait_for_a_proof_that_is_not_wanted(virtual_line: MakeLine) -> None:
    line = virtual_line(SimulatedController(MAP))
    outcomes: list[Outcome] = []
    line.read(line.devices[0], BATTERY_VOLTAGE, outcomes.append)
    line.run(0.5)
    assert state(line) is DeviceState.UNKNOWN
    assert [isinstance(outcome, bytes) for outcome in outcomes] == [True]
