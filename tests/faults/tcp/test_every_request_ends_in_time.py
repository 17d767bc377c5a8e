"""Every request is answered, or its connection closed, within the deadline that `check-config` prints.

A connection, the line engine, a dead controller and the server's watch once a second, all on one virtual clock.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable

import pytest

from gateway.core.budget import WATCH_S, line_budget
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
from gateway.modbus.pdu import ReadRequest
from tests.core.test_engine import Registers
from tests.core.virtual_line import VirtualLine, make_line


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
    """What the kernel would hold for the connection, and when each reply left it."""

    def __init__(self, line: VirtualLine) -> None:
        super().__init__()
        self.line = line
        self.reading = True
        self.closed_at: float | None = None
        self.replies: dict[int, float] = {}

    def write(self, data: bytes | bytearray | memoryview) -> None:
        for adu in mbap.MbapSplitter().feed(bytes(data)):
            self.replies[adu.tid] = self.line.now

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


@pytest.mark.parametrize("dead", [True, False])
@pytest.mark.parametrize("depth", [1, 16, 17, 100, 600])
async def test_a_deep_pipeline_ends_within_the_printed_deadline(depth: int, dead: bool) -> None:
    controller = Registers(1, turnaround_s=0.4)  # slow, but alive
    line = make_line(controller)
    line.run(3.0)
    controller.silent = dead
    device = line.devices[0]
    device.line = VirtualPort(line)
    site = Site.of("ridge-07", [device.line], [device])
    deadline_s = line_budget(line.engine.settings, [device.map]).reply_deadline_s
    settings = ModbusSettings(reply_timeout_s=deadline_s - WATCH_S)
    stats = ModbusServerStats()

    class VirtualClock:
        def monotonic(self) -> float:
            return line.now

        def wall(self) -> float:
            return 1.7e9

    limiter = LineLimiter(LineRates(0.0, 0.0), 1.0, [device])
    dispatcher = Dispatcher(
        Routes(settings, site).by_unit(), VirtualClock(), Shared(stats, Audit(stats.refused), limiter, None)
    )
    client = Client("192.0.2.1", ClientRate(0.0, 0.0), 1.0, line.now)
    connection = Connection(dispatcher, settings, lambda *_: client, lambda _: None)
    transport = VirtualTransport(line)
    connection.connection_made(transport)

    kernel = b"".join(  # no two alike, none in memory
        mbap.encode(tid, device.unit_id, ReadRequest(3, 0x8000 + tid, 1).encode()) for tid in range(depth)
    )
    asked_at = line.now
    while line.now < asked_at + 200.0 and transport.closed_at is None and len(transport.replies) < depth:
        for _ in range(20):
            while kernel and transport.reading and transport.closed_at is None:
                piece, kernel = kernel[:2048], kernel[2048:]
                connection.data_received(piece)
            line.run(WATCH_S / 20)
        reason = connection.overdue(line.now)
        if reason is not None and transport.closed_at is None:
            connection.end(reason)
    answered = len(transport.replies)
    if transport.closed_at is None:
        assert answered == depth
    else:
        assert transport.closed_at - asked_at <= deadline_s
        assert stats.closed == {"unanswered": 1}
    assert max(transport.replies.values(), default=asked_at) - asked_at <= deadline_s
    if depth <= 16:
        assert transport.closed_at is None, "what fits into a window is answered"
    connection.connection_lost(None)
    assert answered >= 1
