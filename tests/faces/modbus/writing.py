"""A gateway's Modbus face that lets somebody write, over a simulated controller that answers when the test lets it."""

from __future__ import annotations

import asyncio
import json
import socket
import struct
from collections import Counter, deque
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass, field, replace
from ipaddress import ip_network
from pathlib import Path
from typing import Any

from gateway.core.ratelimit import ClientRate, LineRates
from gateway.core.site import Device, LineState, LineStatus, Outcome, Site
from gateway.core.snapshot import Block, DeviceState, Snapshot
from gateway.core.stats import LineStats, ModbusServerStats
from gateway.core.write_ledger import Entry, Fate, entries
from gateway.core.write_rules import Range, WriteRule
from gateway.core.write_wear import WearLimits
from gateway.devices.model import Space
from gateway.devices.schema import load_map
from gateway.errors import ReplyTimeout
from gateway.faces.modbus.ledger import NAME, read_ledger
from gateway.faces.modbus.server import ModbusServer
from gateway.faces.modbus.settings import ModbusSettings, RateSettings, WriteSettings
from gateway.modbus import mbap
from gateway.modbus.pdu import ReadRequest
from gateway.simulator.device import SimulatedController

MAP = load_map("prostar-mppt")
NO_LIMITS = RateSettings(ClientRate(0.0, 0.0), LineRates(0.0, 0.0), networks=())
SETTINGS = (Range(0xE000, 0xE04F),)
ALL_COILS = (Range(0, 0xFF),)
RULE = WriteRule(
    (ip_network("127.0.0.1"),),
    unit_ids=frozenset({11}),
    registers=(*SETTINGS, Range(0x25, 0x51)),
    coils=ALL_COILS,
    points=frozenset({"reset_control"}),
)

WALL_OFFSET_S = 1.8e9
"""From the monotonic to the wall clock: 2027."""


class Clock:
    """Time that only a test moves; both clocks step together unless told otherwise."""

    def __init__(self) -> None:
        self.now = 1000.0
        self.wall_offset_s = WALL_OFFSET_S

    def monotonic(self) -> float:
        return self.now

    def wall(self) -> float:
        return self.now + self.wall_offset_s


@dataclass(eq=False)
class Ticket:
    """One question to the line."""

    device: Device
    pdu: bytes
    done: Callable[[Outcome], None] | None
    write: bool

    def cancel(self, keep: Callable[[Outcome], None] | None = None) -> None:
        self.done = None


class ControllerLine:
    """A line with simulated controllers; answers by itself, or when `release` is called while `held`."""

    def __init__(self) -> None:
        self.name, self.index, self.port = "shelter-a", 1, "virtual"
        self.stats = LineStats()
        self.units = {address: SimulatedController(MAP, address=address) for address in (1, 2)}
        self.open = True
        self.held = False
        self.lost: Counter[str] = Counter()  # "read" or "write" → how many of the next ones get no answer
        self.swallowed = 0  # of the writes that get no answer, how many the controller does not even hear
        self.waiting: deque[Ticket] = deque()
        self.sent: list[bytes] = []
        self.clients: set[str] = set()

    def status(self, now: float) -> LineStatus:
        return LineStatus(LineState.OPEN if self.open else LineState.DOWN, 0.0, "", len(self.waiting), 0.0)

    def read(
        self, device: Device, pdu: bytes, done: Callable[[Outcome], None], *, client: str = "", background: bool = False
    ) -> Ticket:
        return self._ask(Ticket(device, pdu, done, write=False), client)

    def write(self, device: Device, pdu: bytes, done: Callable[[Outcome], None], *, client: str = "") -> Ticket:
        return self._ask(Ticket(device, pdu, done, write=True), client)

    @property
    def writes(self) -> list[bytes]:
        """The writes that went out."""
        return [pdu for pdu in self.sent if pdu[0] in {5, 6}]

    def release(self) -> None:
        """Answer what waits."""
        while self.waiting:
            ticket = self.waiting.popleft()
            outcome = self._outcome(ticket)
            done, ticket.done = ticket.done, None
            if done is not None:
                done(outcome)

    def _ask(self, ticket: Ticket, client: str) -> Ticket:
        self.clients.add(client)
        self.waiting.append(ticket)
        if not self.held:
            asyncio.get_running_loop().call_soon(self.release)
        return ticket

    def _outcome(self, ticket: Ticket) -> Outcome:
        self.sent.append(ticket.pdu)
        kind = "write" if ticket.write else "read"
        lost = self.lost[kind] > 0
        if lost:
            self.lost[kind] -= 1
            if ticket.write and self.swallowed:
                self.swallowed -= 1
                return ReplyTimeout()
        if ticket.write:  # as the engine does: what was polled of it is forgotten
            snapshot = ticket.device.snapshot
            ticket.device.snapshot = replace(snapshot, version=snapshot.version + 1)
        reply = self.units[ticket.device.address].handle(ticket.pdu, 1000.0)
        if reply is None and ticket.write:
            return ticket.pdu  # the line takes the silence of a restart for success
        return ReplyTimeout() if lost or reply is None else reply


@dataclass(eq=False)
class Writing:
    """A face with its line, its ledger and clients."""

    folder: Path
    clock: Clock
    line: ControllerLine
    stats: ModbusServerStats
    site: Site
    server: ModbusServer
    streams: list[tuple[asyncio.StreamReader, asyncio.StreamWriter]] = field(default_factory=list)

    @property
    def device(self) -> Device:
        return self.site.by_unit[11]

    async def connect(self) -> int:
        """A further client; gives its number."""
        bound = self.server.listeners[0].bound
        assert bound is not None
        self.streams.append(await asyncio.open_connection(*bound))
        return len(self.streams) - 1

    def ask(self, pdu: str, *, unit: int = 11, client: int = 0) -> None:
        self.streams[client][1].write(mbap.encode(7, unit, bytes.fromhex(pdu)))

    async def answer(self, client: int = 0) -> str:
        reader = self.streams[client][0]
        async with asyncio.timeout(30):
            head = await reader.readexactly(7)
            return (await reader.readexactly(int.from_bytes(head[4:6]) - 1)).hex()

    async def query(self, pdu: str, *, unit: int = 11, client: int = 0) -> str:
        """The reply PDU to a request PDU, both in hexadecimal."""
        self.ask(pdu, unit=unit, client=client)
        return await self.answer(client)

    def reset(self, client: int) -> None:
        """Be gone at once: RST instead of FIN, after which nobody waits for an answer."""
        writer = self.streams[client][1]
        linger = struct.pack("ii", 1, 0)
        writer.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, linger)
        writer.transport.abort()

    async def until(self, condition: Callable[[], object]) -> None:
        async with asyncio.timeout(30):
            while not condition():  # noqa: ASYNC110 - the ledger's thread and the loop set no event of the test's
                await asyncio.sleep(0.002)

    def ledger(self) -> list[Entry]:
        return entries(read_ledger(self.folder))

    def fates(self) -> list[Fate | None]:
        """How the noted writes ended."""
        return [None if entry.verdict is None else entry.verdict.fate for entry in self.ledger()]

    def lines(self) -> list[dict[str, Any]]:
        """The ledger as it is on the disk."""
        path = self.folder / NAME
        return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []

    def holds(self, address: int, unit: int = 1) -> int:
        """What the controller's register holds."""
        return self.line.units[unit].read(Space.REGISTERS, address, 1, 1000.0)[0]

    def poll(self) -> None:
        """Put RAM, settings and coils into the snapshot, as the line's polls would."""
        blocks = []
        for function, first, count in ((3, 0, 0x52), (3, 0xE000, 0x50), (1, 0, 3)):
            reply = self.line.units[1].handle(ReadRequest(function, first, count).encode(), 1000.0)
            assert reply is not None
            blocks.append(Block(MAP.functions[function], first, count, reply[2:], self.clock.now))
        self.device.snapshot = replace(self.device.snapshot, blocks=tuple(blocks))

    async def close(self) -> None:
        for _, writer in self.streams:
            writer.close()
        for listener in self.server.listeners:
            await listener.stop()


@asynccontextmanager
async def writing(
    folder: Path,
    *rules: WriteRule,
    per_day: int = 10,
    interval_s: float = 0.0,
    on: bool = True,
    rate: RateSettings = NO_LIMITS,
    line: ControllerLine | None = None,
    wall_offset_s: float = WALL_OFFSET_S,
) -> AsyncIterator[Writing]:
    """A face on a free port with one client; units 11 and 12 are addresses 1 and 2 of one line, both online."""
    line = line or ControllerLine()
    clock, stats = Clock(), ModbusServerStats()
    clock.wall_offset_s = wall_offset_s
    devices = [
        Device(f"array-{address}", 10 + address, address, MAP, snapshot=Snapshot(state=DeviceState.ONLINE))
        for address in line.units
    ]
    for device in devices:
        device.line = line
    site = Site.of("ridge-07", [line], devices)
    writes = WriteSettings(rules or (RULE,), folder, WearLimits(per_day, interval_s)) if on else None
    settings = ModbusSettings(listen=(("127.0.0.1", 0),), writes=writes, stop_grace_s=0.05, rate=rate)
    made = Writing(folder, clock, line, stats, site, ModbusServer(settings, site, clock, stats))
    for listener in made.server.listeners:
        await listener.start()
    await made.connect()
    try:
        yield made
    finally:
        line.held = False
        await made.close()
