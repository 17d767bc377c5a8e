"""A simulated Modbus TCP server in virtual time, seen from the client's end of its connections.

Rule 1: stations answer under their addresses as unit ids. They hang on one EIA-485 bus behind the server, or, without
    `bus`, are the server itself; either way it works on one request at a time, in the order in which they came, of
    whichever connection.
Rule 2: a unit that is not there, or does not answer, is waited for `patience_s`; then `silence` is the exception that
    the client gets, None for no answer at all.
Rule 3: habits: it may close each connection after one reply, as a TriStar does, throw away what comes while it
    works on something of the same connection, or admit only so many connections at once.
Rule 4: replies keep the order of the requests of their connection, unless chaos says otherwise (tcp_chaos.py).

Nothing here does input or output or reads a clock: `connect`, `receive` bytes, ask `next_event`, `take` at that time.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

from gateway.modbus.mbap import Adu, MbapSplitter, encode
from gateway.modbus.pdu import exception_reply
from gateway.modbus.rtu import Timing
from gateway.simulator.line import Station

_RTU_OVERHEAD = 3  # address and CRC


@dataclass(frozen=True, slots=True)
class Habits:
    """How a server treats its connections, and the units behind it."""

    closes: bool = False  # after every reply
    one_at_a_time: bool = False  # what comes while it works on a request of the connection is thrown away
    admits: int | None = None  # connections at once; a further one is closed unasked
    silence: int | None = 0x0B
    patience_s: float = 0.3
    latency_s: float = 0.0  # of the network, there and back


@dataclass(frozen=True, slots=True)
class Piece:
    """Bytes for the client at a time; `end` is how the connection ends with them: "fin", "reset", "" for not.

    "stuck": it stays, and nothing more is ever sent on it.
    """

    at: float
    data: bytes
    end: str = ""


class Spoiler(Protocol):
    """What may happen to replies."""

    def reply(self, request: Adu, reply: bytes, at: float, waiting: frozenset[int]) -> Sequence[Piece]:
        """What the client gets of a reply ADU; `waiting` are the transaction ids that it still waits for."""
        ...


class Faithful:
    """Nothing happens."""

    def reply(self, request: Adu, reply: bytes, at: float, waiting: frozenset[int]) -> Sequence[Piece]:
        """See `Spoiler.reply`."""
        del request, waiting
        return (Piece(at, reply),)


@dataclass(slots=True)
class ServerCounters:
    """What the server saw."""

    connections: int = 0
    open_connections: int = 0
    most_open: int = 0
    requests: int = 0
    replies: int = 0
    thrown_away: int = 0
    most_waiting: int = 0  # requests of one connection that waited at once
    units: dict[int, int] = field(default_factory=dict)  # unit id → requests


class SimulatedServer:
    """Stations behind one Modbus TCP server; `refusing` lets no connection in."""

    def __init__(
        self,
        stations: Sequence[Station],
        *,
        habits: Habits | None = None,
        bus: Timing | None = None,
        spoiler: Spoiler | None = None,
    ) -> None:
        self.stations = list(stations)
        self.habits = habits or Habits()
        self.spoiler: Spoiler = spoiler or Faithful()
        self.counters = ServerCounters()
        self.refusing = False
        self._bus = bus
        self._free_at = -math.inf

    def connect(self) -> ServerConnection:
        """A client connected."""
        self.counters.connections += 1
        self.counters.open_connections += 1
        self.counters.most_open = max(self.counters.most_open, self.counters.open_connections)
        admits = self.habits.admits
        return ServerConnection(self, unwanted=admits is not None and self.counters.open_connections > admits)

    def work(self, adu: Adu, now: float) -> tuple[float, bytes | None]:
        """When a request that came at `now` is answered, and the reply PDU; None: never."""
        self.counters.requests += 1
        self.counters.units[adu.unit] = self.counters.units.get(adu.unit, 0) + 1
        start = max(now, self._free_at)
        station = next((station for station in self.stations if station.address == adu.unit), None)
        wire_s = 0.0 if self._bus is None else self._bus.wire_s(len(adu.pdu) + _RTU_OVERHEAD) + self._bus.gap_s
        pdu = None if station is None else station.handle(adu.pdu, start + wire_s)
        if station is None or pdu is None:
            self._free_at = start + wire_s + self.habits.patience_s
            silence = self.habits.silence
            return self._free_at, None if silence is None else exception_reply(adu.pdu[0], silence)
        back_s = 0.0 if self._bus is None else self._bus.wire_s(len(pdu) + _RTU_OVERHEAD) + self._bus.gap_s
        self._free_at = start + wire_s + station.turnaround_s + back_s
        return self._free_at, pdu


@dataclass(order=True, slots=True)
class _Due:
    at: float
    number: int
    piece: Piece = field(compare=False)
    tid: int | None = field(compare=False, default=None)  # the request that is answered with it


class ServerConnection:
    """One connection. `ended` is "" while it lasts, else "fin" or "reset": the client sees that after the bytes."""

    def __init__(self, server: SimulatedServer, *, unwanted: bool = False) -> None:
        self.ended = ""
        self._server = server
        self._splitter = MbapSplitter()
        self._due: list[_Due] = []
        self._number = 0
        self._waiting: set[int] = set()
        self._stuck = False
        if unwanted:
            self._due.append(_Due(-math.inf, 0, Piece(-math.inf, b"", "fin")))

    def receive(self, data: bytes, now: float) -> None:
        """Take bytes that the client wrote; they arrive at once, and half of the latency later in effect."""
        if self.ended:
            return
        server = self._server
        for adu in self._splitter.feed(data):
            if server.habits.one_at_a_time and self._waiting:
                server.counters.thrown_away += 1
                continue
            at, pdu = server.work(adu, now + server.habits.latency_s / 2)
            if pdu is None:
                continue
            self._waiting.add(adu.tid)
            server.counters.most_waiting = max(server.counters.most_waiting, len(self._waiting))
            reply = encode(adu.tid, adu.unit, pdu)
            pieces = list(server.spoiler.reply(adu, reply, at + server.habits.latency_s / 2, frozenset(self._waiting)))
            if server.habits.closes and pieces and not pieces[-1].end:
                pieces.append(Piece(pieces[-1].at, b"", "fin"))
            for piece in pieces:
                self._number += 1
                heapq.heappush(self._due, _Due(piece.at, self._number, piece, adu.tid))
        if self._splitter.lost is not None:
            self._close("fin")

    def next_event(self) -> float | None:
        """When there is something for the client; None: nothing yet."""
        return self._due[0].at if self._due and not self.ended and not self._stuck else None

    def take(self, now: float) -> bytes:
        """The bytes that reached the client since the last call; look at `ended` after it."""
        out = b""
        while self._due and self._due[0].at <= now and not self.ended and not self._stuck:
            due = heapq.heappop(self._due)
            out += due.piece.data
            if due.tid in self._waiting:
                self._waiting.discard(due.tid)
                self._server.counters.replies += 1
            if due.piece.end == "stuck":
                self._stuck = True
            elif due.piece.end:
                self._close(due.piece.end)
        return out

    def client_closed(self) -> None:
        """The client ended it."""
        self._close("fin")

    def _close(self, how: str) -> None:
        if not self.ended:
            self.ended = how
            self._server.counters.open_connections -= 1
