"""A small site whose lines refuse to be read: the HTTP face must never ask them."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import NoReturn

import pytest

from gateway.core.site import Device, LineState, LineStatus, Site
from gateway.core.snapshot import DeviceState, Snapshot
from gateway.core.stats import LineStats, ModbusServerStats
from gateway.devices.model import (
    Access,
    Bit,
    DeviceMap,
    EnumValue,
    Group,
    Identification,
    IdentityRules,
    Point,
    Space,
    Value,
)
from gateway.faces.http.app import HttpFace
from gateway.faces.http.settings import HttpSettings


class ManualClock:
    """Time that only a test moves."""

    def __init__(self) -> None:
        self.now = 1000.0
        self.date = 1_700_000_000.0

    def monotonic(self) -> float:
        return self.now

    def wall(self) -> float:
        return self.date


@dataclass
class UnreadableLine:
    """A line as the faces see it; reading it is a failure of the test."""

    name: str
    index: int = 1
    port: str = "/dev/ttyUSB0"
    stats: LineStats = field(default_factory=LineStats)
    state: LineState = LineState.OPEN
    error: str = ""
    echo: str = "absent"

    def status(self, now: float) -> LineStatus:
        return LineStatus(self.state, 0.0, self.error, queue_depth=2, use_ratio=0.25, echo=self.echo)

    def read(self, device: object, pdu: bytes, done: object, *, client: str = "", background: bool = False) -> NoReturn:
        pytest.fail("the HTTP face read a line")

    def write(self, device: object, pdu: bytes, done: object, *, client: str = "") -> NoReturn:
        pytest.fail("the HTTP face wrote")


def make_point(name: str, metric: str | None, **changes: object) -> Point:
    point = Point(
        name=name,
        space=Space.REGISTERS,
        address=0,
        words=1,
        symbol=name,
        group=Group.LIVE,
        unit="",
        help=f"What {name} is.",
        doc="",
        access=Access.READ,
        readings=(),
        minimum=None,
        maximum=None,
        enumeration=None,
        bits=None,
        confidence="documented",
        mib=None,
        metric=metric,
        metric_scale=1.0,
    )
    return replace(point, **changes)  # type: ignore[arg-type]  # replace checks the names


def make_map(*points: Point, model: str = "sun-1") -> DeviceMap:
    return DeviceMap(
        model=model,
        title="Sun One",
        document="",
        functions=MappingProxyType({}),
        write_functions=MappingProxyType({}),
        extents=(),
        reserved=(),
        points=points,
        enumerations={"stage": (EnumValue(0, "night", "Night"), EnumValue(5, "bulk", "Bulk"))},
        bit_tables={"faults": (Bit(0, "overcurrent", "", "critical"), Bit(3, "battery_hvd", "", "critical"))},
        log=None,
        identity=IdentityRules((), (), "", None, 0),
    )


SUN = make_map(
    make_point("battery_voltage", "morningstar_battery_voltage_volts"),
    make_point("energy", "morningstar_energy_joules_total", metric_scale=3.6e6),
    make_point("charge_state", "morningstar_charge_state", enumeration="stage"),
    make_point("array_fault", "morningstar_array_fault", bits="faults"),
    make_point("hidden", None),
)

VALUES: dict[str, Value] = {
    "battery_voltage": 12.5,
    "energy": 2,
    "charge_state": 5,
    "array_fault": 0b1000,
    "hidden": 7,
}


def online(now: float, **changes: object) -> Snapshot:
    """An online device with all values of `SUN`, heard at `now`."""
    snapshot = Snapshot(
        version=1,
        state=DeviceState.ONLINE,
        last_reply_at=now,
        values=VALUES,
        read_at=dict.fromkeys(VALUES, now),
        identification=Identification("Morningstar Corp.", "Sun One", "v1"),
        serial_number="17340001",
    )
    return replace(snapshot, **changes)  # type: ignore[arg-type]  # replace checks the names


def make_device(name: str, unit_id: int, line: UnreadableLine, device_map: DeviceMap = SUN) -> Device:
    device = Device(name=name, unit_id=unit_id, address=1, map=device_map)
    device.line = line
    return device


@pytest.fixture
def clock() -> ManualClock:
    return ManualClock()


@pytest.fixture
def site(clock: ManualClock) -> Site:
    """Two lines with a controller each: array-1 (unit 11) is online, array-2 (unit 12) was never heard."""
    lines = (UnreadableLine("shelter-a"), UnreadableLine("shelter-b", index=2))
    devices = (make_device("array-1", 11, lines[0]), make_device("array-2", 12, lines[1]))
    devices[0].snapshot = online(clock.now)
    return Site.of("ridge-07", lines, devices)


class Gateway:
    """What the HTTP face is told, to be changed by a test, and the face."""

    def __init__(self, site: Site, clock: ManualClock, settings: HttpSettings) -> None:
        self.site = site
        self.clock = clock
        self.modbus = ModbusServerStats()
        self.snmp: dict[str, int] = {}
        self.not_ready: list[str] = []
        self.face = HttpFace(
            settings,
            site,
            clock,
            modbus=self.modbus,
            snmp=lambda: self.snmp,
            not_ready=lambda: self.not_ready,
        )

    @property
    def url(self) -> str:
        """Where the first listener answers."""
        bound = self.face.listeners[0].bound
        assert bound is not None
        return f"http://{bound[0]}:{bound[1]}"

    @asynccontextmanager
    async def running(self) -> AsyncIterator[Gateway]:
        """Listen for the time of the block."""
        for listener in self.face.listeners:
            await listener.start()
        try:
            yield self
        finally:
            for listener in self.face.listeners:
                await listener.stop()


@pytest.fixture
def make_gateway(site: Site, clock: ManualClock) -> Callable[..., Gateway]:
    """A face of the site, or of another one, on a port that the system chooses; settings may be given by name."""

    def make(of: Site = site, **settings: object) -> Gateway:
        chosen = replace(HttpSettings(listen=(("127.0.0.1", 0),)), **settings)  # type: ignore[arg-type]  # as above
        return Gateway(of, clock, chosen)

    return make


@pytest.fixture
async def gateway(make_gateway: Callable[..., Gateway]) -> AsyncIterator[Gateway]:
    async with make_gateway().running() as running:
        yield running
