"""Modbus TCP connections in front of a line engine and simulated controllers, on one virtual clock, without sockets."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from gateway.core.clients import Client
from gateway.core.policy import Audit
from gateway.core.ratelimit import ClientRate, LineLimiter, LineRates
from gateway.core.requests import Waiter
from gateway.core.site import Device, LineState, LineStatus, Outcome, Site
from gateway.core.stats import LineStats, ModbusServerStats
from gateway.faces.modbus.connection import Connection
from gateway.faces.modbus.dispatch import Dispatcher, Routes, Shared
from gateway.faces.modbus.settings import ModbusSettings
from gateway.modbus import mbap
from tests.core.virtual_line import VirtualLine


class VirtualPort:
    """The virtual line as devices know it."""

    name = "line"
    index = 1
    port = "virtual"
    stats = LineStats()

    def __init__(self, line: VirtualLine) -> None:
        self.line = line

    def status(self, now: float) -> LineStatus:
        return LineStatus(LineState.OPEN, now, "", 0, 0.0)

    def read(
        self, device: Device, pdu: bytes, done: Callable[[Outcome], None], *, client: str = "", background: bool = False
    ) -> Waiter:
        return self.line.read(device, pdu, done, client)

    def write(self, device: Device, pdu: bytes, done: Callable[[Outcome], None], *, client: str = "") -> Waiter:
        return self.line.write(device, pdu, done, client)


class VirtualTransport(asyncio.Transport):
    """What the kernel would hold for a connection: each reply, and when it left."""

    def __init__(self, line: VirtualLine) -> None:
        super().__init__()
        self.line = line
        self.reading = True
        self.closed_at: float | None = None
        self.replies: dict[int, tuple[float, mbap.Adu]] = {}  # by transaction id

    def write(self, data: bytes | bytearray | memoryview) -> None:
        for adu in mbap.MbapSplitter().feed(bytes(data)):
            self.replies[adu.tid] = (self.line.now, adu)

    def is_closing(self) -> bool:
        return self.closed_at is not None

    def pause_reading(self) -> None:
        self.reading = False

    def resume_reading(self) -> None:
        self.reading = True

    def set_write_buffer_limits(self, high: int | None = None, low: int | None = None) -> None:
        pass

    def close(self) -> None:
        self.closed_at = self.closed_at or self.line.now

    def abort(self) -> None:
        self.close()


class VirtualFace:
    """The way in to the devices of a line; connects them to it."""

    def __init__(self, line: VirtualLine, settings: ModbusSettings) -> None:
        self.line = line
        self.settings = settings
        self.stats = ModbusServerStats()
        port = VirtualPort(line)
        for device in line.devices:
            device.line = port
        site = Site.of("ridge-07", [port], line.devices)
        limiter = LineLimiter(LineRates(0.0, 0.0), 1.0, line.devices)
        shared = Shared(self.stats, Audit(self.stats.refused), limiter, None)
        self._dispatcher = Dispatcher(Routes(settings, site).by_unit(), self, shared)

    def monotonic(self) -> float:
        return self.line.now

    def wall(self) -> float:
        return 1.7e9

    def connect(self, name: str = "192.0.2.1") -> tuple[Connection, VirtualTransport]:
        """A client that may ask as often as it likes."""
        client = Client(name, ClientRate(0.0, 0.0), 1.0, self.line.now)
        connection = Connection(self._dispatcher, self.settings, lambda *_: client, lambda _: None)
        transport = VirtualTransport(self.line)
        connection.connection_made(transport)
        return connection, transport
