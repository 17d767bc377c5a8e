"""A site in memory: devices whose registers all differ, on lines that answer when a test lets them."""

from __future__ import annotations

import asyncio
import contextlib
import importlib.util
import os
import socket
import struct
from collections import deque
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable
from dataclasses import dataclass, field, replace

import pytest

from gateway.core.ratelimit import ClientRate, LineRates
from gateway.core.site import Device, LineState, LineStatus, Outcome, Site
from gateway.core.snapshot import Block, DeviceState, Snapshot
from gateway.core.stats import LineStats, ModbusServerStats
from gateway.devices.model import DeviceMap, Extent, IdentityRules, PollClass, Space
from gateway.faces.modbus.server import ModbusServer
from gateway.faces.modbus.settings import ModbusSettings, RateSettings
from gateway.modbus import mbap
from gateway.modbus.pdu import parse_read


def register(address: int, register: int) -> int:
    """What a device of that address holds: no two devices and no two neighbours have the same."""
    return (address << 12 | register * 7) & 0xFFFF


def registers(address: int, first: int, count: int) -> bytes:
    return b"".join(register(address, at).to_bytes(2) for at in range(first, first + count))


def coil(address: int, number: int) -> bool:
    return (number * (address + 1)) % 3 == 0


def coils(address: int, first: int, count: int) -> bytes:
    bits = sum(coil(address, first + at) << at for at in range(count))
    return bits.to_bytes((count + 7) // 8, "little")


ADDRESS = {11: 1, 12: 2, 21: 1}
"""The address of each unit on its line."""


def read(unit: int, first: int, count: int) -> tuple[bytes, bytes]:
    """A request PDU and the reply it must get."""
    data = registers(ADDRESS[unit], first, count)
    return b"\x03" + first.to_bytes(2) + count.to_bytes(2), bytes((3, len(data))) + data


READ_1 = bytes.fromhex("03 0000 0001")
READ_80 = bytes.fromhex("03 0000 0050")
GOOD = mbap.encode(1, 12, READ_1)
GOOD_REPLY = mbap.encode(1, 12, b"\x03\x02" + registers(2, 0, 1))


def device_map() -> DeviceMap:
    """The extents and functions of a ProStar without its points."""
    doc = "ProStar MPPT v05"
    return DeviceMap(
        model="prostar-mppt",
        title="ProStar MPPT",
        document=doc,
        functions={1: Space.COILS, 2: Space.COILS, 3: Space.REGISTERS, 4: Space.REGISTERS},
        write_functions={5: Space.COILS, 6: Space.REGISTERS},
        extents=(
            Extent("ram", Space.REGISTERS, 0x0000, 0x0051, PollClass.LIVE, writable=False, doc=doc),
            Extent("eeprom", Space.REGISTERS, 0xE000, 0xE04F, PollClass.SETTINGS, writable=True, doc=doc),
            Extent("coils", Space.COILS, 0x00, 0xFF, PollClass.SETTINGS, writable=True, doc=doc),
        ),
        reserved=(),
        points=(),
        enumerations={},
        bit_tables={},
        log=None,
        identity=IdentityRules((), (), "", None, 0),
    )


NO_LIMITS = RateSettings(ClientRate(0.0, 0.0), LineRates(0.0, 0.0), networks=())


class FakeClock:
    """Time that only a test moves."""

    def __init__(self) -> None:
        self.now = 1000.0

    def monotonic(self) -> float:
        return self.now

    def wall(self) -> float:
        return 1.7e9 + self.now


@dataclass(eq=False)
class Read:
    """One transaction that waits on the fake line."""

    device: Device
    pdu: bytes
    waiters: list[FakeTicket] = field(default_factory=list)


@dataclass(eq=False)
class FakeTicket:
    done: Callable[[Outcome], None] | None
    client: str = ""

    def cancel(self, keep: Callable[[Outcome], None] | None = None) -> None:
        self.done = None


class FakeLine:
    """Answers reads like the devices would: at once, or when `release` is called while it is `held`."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.index = 1
        self.port = f"/dev/{name}"
        self.stats = LineStats()
        self.held = False
        self.open = True
        self.outcomes: dict[int, Outcome] = {}  # device address → outcome instead of its registers
        self.waiting: deque[Read] = deque()
        self.transactions: list[tuple[int, bytes]] = []
        self._scheduled = False

    def status(self, now: float) -> LineStatus:
        state = LineState.OPEN if self.open else LineState.DOWN
        return LineStatus(state, now, "" if self.open else "unplugged", len(self.waiting), 0.0)

    def write(self, device: Device, pdu: bytes, done: Callable[[Outcome], None], *, client: str = "") -> FakeTicket:
        return self.read(device, pdu, done, client=client)

    def read(
        self, device: Device, pdu: bytes, done: Callable[[Outcome], None], *, client: str = "", background: bool = False
    ) -> FakeTicket:
        ticket = FakeTicket(done, client)
        for read in self.waiting:
            if read.device is device and read.pdu == pdu:
                read.waiters.append(ticket)
                return ticket
        self.waiting.append(Read(device, pdu, [ticket]))
        if not self.held and not self._scheduled:
            self._scheduled = True
            asyncio.get_running_loop().call_soon(self._answer_all)
        return ticket

    def release(self, count: int | None = None) -> None:
        """Answer the first `count` waiting reads, or all."""
        for _ in range(len(self.waiting) if count is None else count):
            read = self.waiting.popleft()
            self.transactions.append((read.device.address, read.pdu))
            outcome = self.outcomes.get(read.device.address) or self.reply(read.device, read.pdu)
            for ticket in read.waiters:
                done, ticket.done = ticket.done, None
                if done is not None:
                    done(outcome)

    def reply(self, device: Device, pdu: bytes) -> bytes:
        if pdu[0] == 0x2B:
            return b"\x2b\x0e\x01\x01\x00\x00\x01\x00\x04LINE" if pdu[2] == 1 else b"\xab\x01"
        read = parse_read(pdu)
        space = device.map.functions[read.function]
        extents = [extent for extent in device.map.extents if extent.space is space]
        if not any(e.first <= read.address and read.address + read.count <= e.last + 1 for e in extents):
            return bytes((read.function | 0x80, 0x02))
        data = (registers if space is Space.REGISTERS else coils)(device.address, read.address, read.count)
        return bytes((read.function, len(data))) + data

    def _answer_all(self) -> None:
        self._scheduled = False
        if not self.held:
            self.release()


@dataclass(eq=False)
class World:
    """Two lines; units 11 and 12 on the first, 21 (with the address of 11) on the second."""

    clock: FakeClock
    lines: tuple[FakeLine, FakeLine]
    site: Site
    counters: ModbusServerStats
    servers: list[ModbusServer] = field(default_factory=list)

    @property
    def stats(self) -> ModbusServerStats:
        """The counters, up to date."""
        for server in self.servers:
            server.clients.settle()
        return self.counters

    def device(self, unit: int) -> Device:
        return self.site.by_unit[unit]

    def line(self, unit: int) -> FakeLine:
        line = self.device(unit).line
        assert isinstance(line, FakeLine)
        return line

    def poll(self, unit: int, *, age_s: float = 0.0) -> None:
        """Put a whole read of RAM and coils into the snapshot, as the line's poll would."""
        device = self.device(unit)
        at = self.clock.now - age_s
        device.snapshot = replace(
            device.snapshot,
            version=device.snapshot.version + 1,
            state=DeviceState.ONLINE,
            last_reply_at=at,
            blocks=(
                Block(Space.REGISTERS, 0x0000, 0x52, registers(device.address, 0, 0x52), at),
                Block(Space.COILS, 0, 256, coils(device.address, 0, 256), at),
            ),
        )

    def set_state(self, unit: int, state: DeviceState) -> None:
        device = self.device(unit)
        device.snapshot = replace(device.snapshot, state=state, state_since=self.clock.now)


def pytest_asyncio_loop_factories() -> dict[str, Callable[[], asyncio.AbstractEventLoop]]:
    """Every test of this room runs on both loops; the fast one is optional, but where CI is set (tests/optional.py)."""
    factories: dict[str, Callable[[], asyncio.AbstractEventLoop]] = {"asyncio": asyncio.new_event_loop}
    if os.environ.get("CI") or importlib.util.find_spec("uvloop") is not None:
        factories["uvloop"] = importlib.import_module("uvloop").new_event_loop
    return factories


@pytest.fixture
def world() -> World:
    lines = (FakeLine("shelter-a"), FakeLine("shelter-b"))
    devices = []
    for unit, address, line in ((11, 1, lines[0]), (12, 2, lines[0]), (21, 1, lines[1])):
        device = Device(f"array-{unit}", unit, address, device_map(), snapshot=Snapshot())
        device.line = line
        devices.append(device)
    return World(FakeClock(), lines, Site.of("ridge-07", lines, devices), ModbusServerStats())


@dataclass(eq=False)
class Client:
    """A raw TCP client that reads whole ADUs."""

    reader: asyncio.StreamReader
    writer: asyncio.StreamWriter

    def send(self, data: bytes) -> None:
        self.writer.write(data)

    def ask(self, tid: int, unit: int, pdu: bytes) -> None:
        self.send(mbap.encode(tid, unit, pdu))

    async def adu(self) -> mbap.Adu:
        async with asyncio.timeout(30):
            head = await self.reader.readexactly(7)
            assert head[2:4] == b"\0\0"
            pdu = await self.reader.readexactly(int.from_bytes(head[4:6]) - 1)
        return mbap.Adu(int.from_bytes(head[:2]), head[6], pdu)

    async def adus(self, count: int) -> list[mbap.Adu]:
        return [await self.adu() for _ in range(count)]

    async def query(self, unit: int, pdu: bytes, tid: int = 1) -> bytes:
        self.ask(tid, unit, pdu)
        reply = await self.adu()
        assert (reply.tid, reply.unit) == (tid, unit)
        return reply.pdu

    async def rest(self) -> bytes:
        """What still comes until the server closes; a reset counts as closing."""
        out = bytearray()
        async with asyncio.timeout(30):
            with contextlib.suppress(ConnectionError):
                while data := await self.reader.read(65536):
                    out += data
        return bytes(out)

    def reset(self) -> None:
        """Be gone at once: RST instead of FIN."""
        sock = self.writer.get_extra_info("socket")
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self.writer.transport.abort()

    async def close(self) -> None:
        self.writer.close()
        with contextlib.suppress(OSError):
            await self.writer.wait_closed()


@dataclass(eq=False)
class Running:
    """A started server and its clients."""

    server: ModbusServer
    world: World
    clients: list[Client] = field(default_factory=list)

    @property
    def address(self) -> tuple[str, int]:
        return self.bound(0)

    def bound(self, listener: int) -> tuple[str, int]:
        bound = self.server.listeners[listener].bound
        assert bound is not None
        return bound

    async def connect(self, listener: int = 0, **options: object) -> Client:
        reader, writer = await asyncio.open_connection(*self.bound(listener), **options)  # type: ignore[arg-type]
        client = Client(reader, writer)
        self.clients.append(client)
        return client

    async def until(self, condition: Callable[[], bool]) -> None:
        """Let the loop run until it is so."""
        async with asyncio.timeout(30):
            while not condition():  # noqa: ASYNC110 - the condition is the kernel's or the server's, which set no event
                await asyncio.sleep(0.001)


Serve = Callable[..., Awaitable[Running]]


@pytest.fixture
async def serve(world: World) -> AsyncIterator[Serve]:
    """Start a server with `settings` changed as given; stopped and checked for leftovers afterwards."""
    started: list[Running] = []

    async def start(**settings: object) -> Running:
        values: dict[str, object] = {"listen": (("127.0.0.1", 0),), "stop_grace_s": 0.05, "rate": NO_LIMITS, **settings}
        server = ModbusServer(ModbusSettings(**values), world.site, world.clock, world.counters)  # type: ignore[arg-type]
        world.servers.append(server)
        for listener in server.listeners:
            await listener.start()
        running = Running(server, world)
        started.append(running)
        return running

    yield start
    for running in started:
        await _close(running.clients)
        for listener in running.server.listeners:
            await listener.stop()
        assert world.stats.closed["error"] == 0
        await running.until(lambda: world.stats.open_connections == 0)


async def _close(clients: Iterable[Client]) -> None:
    for client in clients:
        await client.close()


@pytest.fixture
async def running(serve: Serve) -> Running:
    return await serve()
