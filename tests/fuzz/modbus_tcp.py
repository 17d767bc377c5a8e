"""One Modbus TCP connection fed with any bytes, without sockets: what comes back must be what the contract allows.

Used by the test of F40 with a seeded generator, and by fuzz_modbus_tcp.py with atheris.
"""

from __future__ import annotations

import asyncio
import time
from random import Random

from gateway.core.clients import Client
from gateway.core.policy import Audit
from gateway.core.ratelimit import ClientRate, LineLimiter, LineRates
from gateway.core.site import Device, Site
from gateway.core.snapshot import Snapshot
from gateway.core.stats import ModbusServerStats
from gateway.faces.modbus.connection import Connection
from gateway.faces.modbus.dispatch import Dispatcher, Routes, Shared
from gateway.faces.modbus.settings import ModbusSettings
from gateway.faces.modbus.sockets import READ_BYTES
from gateway.modbus import mbap
from tests.faces.modbus.conftest import FakeClock, FakeLine, World, device_map

DOCUMENTED = {0x01, 0x02, 0x03, 0x04, 0x06, 0x0A, 0x0B}
READABLE = {1, 2, 3, 4, 0x2B}
UNITS = (0, 11, 12, 12, 12, 21, 99, 250, 255)
TURNS = 10_000


class Transport(asyncio.Transport):
    """Takes every reply."""

    def __init__(self) -> None:
        super().__init__()
        self.out = bytearray()
        self.reading = True
        self.closed = False

    def write(self, data: bytes | bytearray | memoryview) -> None:
        """Keep it."""
        assert not self.closed, "nothing is sent after the end"
        self.out += data

    def is_closing(self) -> bool:
        """Whether it was ended."""
        return self.closed

    def pause_reading(self) -> None:
        """Leave the rest where it is."""
        self.reading = False

    def resume_reading(self) -> None:
        """Take it again."""
        self.reading = True

    def set_write_buffer_limits(self, high: int | None = None, low: int | None = None) -> None:
        """Nothing is ever left over."""

    def close(self) -> None:
        """End."""
        self.closed = True

    abort = close


class Target:
    """A face with three devices, one of them in memory. Must be used on a running loop."""

    def __init__(self) -> None:
        self.lines = (FakeLine("shelter-a"), FakeLine("shelter-b"))
        devices = []
        for unit, address, line in ((11, 1, self.lines[0]), (12, 2, self.lines[0]), (21, 1, self.lines[1])):
            line.held = True
            device = Device(f"array-{unit}", unit, address, device_map(), snapshot=Snapshot())
            device.line = line
            devices.append(device)
        self.clock = FakeClock()
        self.site = Site.of("ridge-07", self.lines, devices)
        self.stats = ModbusServerStats()
        self.settings = ModbusSettings()
        limiter = LineLimiter(LineRates(0.0, 0.0), 1.0, devices)
        self.dispatcher = Dispatcher(
            Routes(self.settings, self.site).by_unit(),
            self.clock,
            Shared(self.stats, Audit(self.stats.refused), limiter, None),
        )
        self.client = Client("192.0.2.1", ClientRate(0.0, 0.0), 1.0, 0.0)
        self.slowest_s = 0.0  # CPU time of the longest turn
        World(self.clock, self.lines, self.site, self.stats).poll(12)

    async def feed(self, stream: bytes, cuts: list[int]) -> None:
        """Send a stream in pieces and then its end; AssertionError when what comes back is not in the contract."""
        connection = Connection(self.dispatcher, self.settings, lambda *_: self.client, lambda _: None)
        transport = Transport()
        connection.connection_made(transport)
        at = 0
        for cut in [*sorted(cut for cut in cuts if 0 < cut < len(stream)), len(stream)]:
            while at < cut and not transport.closed:
                if transport.reading:
                    piece = stream[at : min(cut, at + READ_BYTES)]
                    at += len(piece)
                    began = time.thread_time()
                    connection.data_received(piece)
                    self.slowest_s = max(self.slowest_s, time.thread_time() - began)
                await self._answer()
        if not transport.closed:
            connection.eof_received()
        for _ in range(TURNS):
            if transport.closed:
                break
            await self._answer()
        assert transport.closed, "a connection whose client has said all is over when all is answered"
        connection.connection_lost(None)
        check(stream, bytes(transport.out))
        assert self.stats.closed["error"] == 0

    async def _answer(self) -> None:
        for line in self.lines:
            line.release()
            line.transactions.clear()
        await asyncio.sleep(0)


def check(stream: bytes, out: bytes) -> None:
    """Every whole request before a loss of framing has one reply, in order, of the documented kind, and there are no
    other bytes.
    """
    splitter = mbap.MbapSplitter()
    replies = splitter.feed(out)
    assert splitter.lost is None
    assert not splitter.pending
    asked = requests(stream)
    assert len(replies) == len(asked)
    for reply, (tid, unit, function) in zip(replies, asked, strict=True):
        assert (reply.tid, reply.unit) == (tid, unit)
        if reply.pdu[0] & 0x80:
            assert reply.pdu[0] == function | 0x80
            assert len(reply.pdu) == 2
            assert reply.pdu[1] in DOCUMENTED
        else:
            assert reply.pdu[0] == function
            assert function in READABLE


def requests(stream: bytes) -> list[tuple[int, int, int]]:
    """Transaction id, unit and function of each request that must be answered."""
    out: list[tuple[int, int, int]] = []
    at = foreign = 0
    while len(stream) - at >= 6:
        tid, protocol, length = (int.from_bytes(stream[at + i : at + i + 2]) for i in (0, 2, 4))
        if not 2 <= length <= 254 or at + 6 + length > len(stream):
            break
        foreign = foreign + 1 if protocol else 0
        if foreign == 3:
            break
        if not protocol:
            out.append((tid, stream[at + 6], stream[at + 7]))
        at += 6 + length
    return out


def mutated(rng: Random) -> tuple[bytes, list[int]]:
    """A stream of requests with mistakes in it, and where it is cut."""
    stream = bytearray()
    for _ in range(rng.randrange(1, 40)):
        function = rng.choice((1, 2, 3, 3, 3, 4, 5, 6, 15, 16, 22, 23, 0x2B, rng.randrange(256)))
        if rng.random() < 0.9:
            pdu = bytes((function,)) + rng.randrange(90).to_bytes(2) + rng.choice((1, 80, 126, 65535)).to_bytes(2)
        else:
            pdu = rng.randbytes(rng.randrange(1, 254))
        stream += mbap.encode(rng.randrange(65536), rng.choice(UNITS), pdu)
    for _ in range(rng.choice((0, 0, 1, 1, 2, 5))):
        at = rng.randrange(len(stream) or 1)
        match rng.randrange(4):
            case 0 if stream:
                stream[at] ^= 1 << rng.randrange(8)
            case 1:
                del stream[at : at + rng.randrange(1, 12)]
            case 2:
                stream[at:at] = stream[at : at + rng.randrange(1, 24)]
            case _:
                stream[at:at] = rng.randbytes(rng.randrange(1, 12))
    return bytes(stream), [rng.randrange(1, 600) for _ in range(rng.randrange(6))]
