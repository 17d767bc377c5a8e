"""A site of fake lines with known snapshots, and what it takes to ask an agent about it."""

from __future__ import annotations

import asyncio
import os
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

from gateway.core.daylog import LoggedDay
from gateway.core.site import Device, LineState, LineStatus, Outcome, Ticket
from gateway.core.snapshot import DeviceState, Snapshot
from gateway.core.stats import LineStats
from gateway.devices.model import DeviceMap, Identification, Kind, Value
from gateway.faces.snmp.agent import SnmpAgent
from tests.netsnmp import without_new_folders

REPOSITORY = Path(__file__).parents[3]
NOW = 1000.0


@dataclass
class StubClock:
    now: float = NOW

    def monotonic(self) -> float:
        return self.now

    def wall(self) -> float:
        return 0.0


@dataclass
class StubLine:
    """A line that is never asked: the SNMP face reads snapshots only."""

    name: str
    index: int
    port: str
    state: LineState = LineState.OPEN
    stats: LineStats = field(default_factory=LineStats)

    def status(self, now: float) -> LineStatus:
        error = "" if self.state is LineState.OPEN else "no such device"
        return LineStatus(self.state, NOW + 5.0, error, 3, 0.75)

    def read(
        self, device: Device, pdu: bytes, done: Callable[[Outcome], None], *, client: str = "", background: bool = False
    ) -> Ticket:
        raise AssertionError("the SNMP face asked a line")

    def write(self, device: Device, pdu: bytes, done: Callable[[Outcome], None], *, client: str = "") -> Ticket:
        raise AssertionError("the SNMP face wrote")


def values_of(device_map: DeviceMap, unit_id: int) -> dict[str, Value]:
    """A value for every point that differs by point and device and fits every syntax."""
    values: dict[str, Value] = {}
    for position, point in enumerate(device_map.points):
        if point.kind is Kind.TEXT:
            continue
        if point.enumeration is not None:
            numbers = [each.number for each in device_map.enumerations[point.enumeration]]
            values[point.name] = numbers[(position + unit_id) % len(numbers)]
        elif point.bits is not None:
            named = device_map.bit_tables[point.bits]
            values[point.name] = 1 << named[(position + unit_id) % len(named)].number
        elif point.mib is not None and point.mib.syntax == "Integer32":
            values[point.name] = unit_id + position / 8
        else:
            values[point.name] = unit_id * 1000 + position
    return values


def texts_of(device_map: DeviceMap, unit_id: int) -> dict[str, str]:
    """A text for every point that is one, likewise."""
    return {point.name: f"{point.name} of {unit_id}" for point in device_map.points if point.kind is Kind.TEXT}


def online(device_map: DeviceMap, unit_id: int, at: float = NOW) -> Snapshot:
    values = values_of(device_map, unit_id)
    return Snapshot(
        version=1,
        state=DeviceState.ONLINE,
        state_since=at,
        last_reply_at=at,
        values=values,
        texts=texts_of(device_map, unit_id),
        read_at=dict.fromkeys(values, at),
        identification=Identification("Morningstar Corp.", "PS-MPPT-40M", "v01.02.13"),
        serial_number="16250001",
    )


def log(*hours: int) -> list[LoggedDay]:
    """Days with a value in every field."""
    values: dict[str, Value] = {
        "alarms": 1,
        "load_faults": 1,
        "array_faults": 1,
        "battery_voltage_minimum": 11.5,
        "battery_voltage_maximum": 14.4,
        "charge": 12.25,
        "load_charge": 9.5,
        "array_voltage_maximum": 60.5,
        "absorption_time": 3600,
        "equalize_time": 0,
        "float_time": 120,
    }
    return [LoggedDay(each, values, 1.7e9, 1800.0) for each in hours]


def stale(snapshot: Snapshot) -> Snapshot:
    return replace(snapshot, version=snapshot.version + 1, state=DeviceState.STALE, state_since=NOW + 9.0)


@asynccontextmanager
async def listening(agent: SnmpAgent, number: int = 0) -> AsyncIterator[tuple[str, int]]:
    listener = agent.listeners[number]
    await listener.start()
    try:
        assert listener.bound is not None
        yield listener.bound
    finally:
        await listener.stop()


Ask = Callable[..., Awaitable[tuple[int, str]]]
"""`code, output = await ask("snmpget", oid, ..., options=("-c", "public"))`."""


async def run_tool(*command: str, environment: dict[str, str] | None = None) -> tuple[int, str]:
    process = await asyncio.create_subprocess_exec(
        *command,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.STDOUT,
        env={**os.environ, "SNMPCONFPATH": "/nonexistent", **(environment or {})},
    )
    try:
        output, _ = await asyncio.wait_for(process.communicate(), 30)
    except BaseException:
        process.kill()
        await process.wait()
        raise
    assert process.returncode is not None
    return process.returncode, without_new_folders(output.decode())
