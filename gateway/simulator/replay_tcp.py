"""A Modbus TCP server that answers as an upstream did when it was recorded.

Rule 1: a request, whatever its transaction id, is answered with the reply that the same request to the same unit had in
        the recording, after the same time; where that had none, it has none. Transaction ids are those of the asker.
Rule 2: what was asked several times is answered in the order of the recording, then from the beginning again.
Rule 3: a connection that was closed after a reply, or instead of one, is closed then.
Rule 4: what was never asked is not answered, and counted. Bytes that were no reply to anything are left out.
"""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace

from gateway.modbus.mbap import Adu, MbapSplitter, encode
from gateway.modbus.recording import Piece, Recording

Question = tuple[int, bytes]
"""Unit id and request PDU."""


@dataclass(frozen=True, slots=True)
class Exchange:
    """What came of a request, after `delay_s`; `reply` is None for nothing. `closes`: with it the connection ended."""

    question: Question
    delay_s: float
    reply: Adu | None = None
    closes: bool = False


class _Connection:
    """A connection of the recording."""

    def __init__(self) -> None:
        self._sent, self._received = MbapSplitter(), MbapSplitter()
        self._waiting: dict[int, tuple[Question, float]] = {}
        self._last: Exchange | None = None  # answered, and not yet given: the connection may end with it

    def take(self, piece: Piece) -> Iterator[Exchange]:
        """What is known with this piece."""
        if piece.sent:
            yield from self._settle()
            for adu in self._sent.feed(piece.data):
                self._waiting[adu.tid] = ((adu.unit, adu.pdu), piece.at_s)
            return
        for adu in self._received.feed(piece.data):
            if adu.tid in self._waiting:
                yield from self._settle()
                question, asked_at = self._waiting.pop(adu.tid)
                self._last = Exchange(question, piece.at_s - asked_at, adu)

    def end(self, at_s: float, *, remote: bool) -> Iterator[Exchange]:
        """It is over."""
        if self._last is not None:
            yield replace(self._last, closes=remote and not self._waiting)
        for question, asked_at in self._waiting.values():
            yield Exchange(question, at_s - asked_at, closes=remote)

    def _settle(self) -> Iterator[Exchange]:
        if self._last is not None:
            yield self._last
            self._last = None


def exchanges_of(recording: Recording) -> Iterator[Exchange]:
    """All that was asked and what came of it, as far as the recording tells."""
    connections: dict[int, _Connection] = {}
    for piece in recording.pieces:
        if not piece.data:
            yield from connections.pop(piece.connection, _Connection()).end(piece.at_s, remote=not piece.sent)
            continue
        yield from connections.setdefault(piece.connection, _Connection()).take(piece)
    for connection in connections.values():
        yield from connection.end(0.0, remote=False)


class ReplayedServer:
    """The upstream of a recording; satisfies `tcp.Server`."""

    refusing = False

    def __init__(self, recording: Recording) -> None:
        self.answered = 0
        self.unknown = 0  # requests that are not in the recording
        self._known: dict[Question, deque[Exchange]] = {}
        for exchange in exchanges_of(recording):
            self._known.setdefault(exchange.question, deque()).append(exchange)

    @property
    def requests(self) -> int:
        """How many different requests it knows."""
        return len(self._known)

    def connect(self) -> ReplayedConnection:
        """A client connected."""
        return ReplayedConnection(self)

    def answer(self, question: Question) -> Exchange | None:
        """What comes of a request now; None when it was never asked."""
        known = self._known.get(question)
        if known is None:
            self.unknown += 1
            return None
        self.answered += 1
        exchange = known[0]
        known.rotate(-1)
        return exchange


class ReplayedConnection:
    """One connection; satisfies `tcp.Connection`."""

    def __init__(self, server: ReplayedServer) -> None:
        self.ended = ""
        self._server = server
        self._splitter = MbapSplitter()
        self._due: list[tuple[float, int, bytes, bool]] = []
        self._number = 0

    def receive(self, data: bytes, now: float) -> None:
        """Bytes of requests came."""
        for tid, unit, pdu in self._splitter.feed(data):
            exchange = self._server.answer((unit, pdu))
            if exchange is None or (exchange.reply is None and not exchange.closes):
                continue
            reply = b"" if exchange.reply is None else encode(tid, exchange.reply.unit, exchange.reply.pdu)
            self._number += 1
            heapq.heappush(self._due, (now + exchange.delay_s, self._number, reply, exchange.closes))
        if self._splitter.lost is not None:
            self.ended = "fin"

    def next_event(self) -> float | None:
        """When there is something for the client."""
        return self._due[0][0] if self._due and not self.ended else None

    def take(self, now: float) -> bytes:
        """What the client gets by now; look at `ended` after it."""
        out = b""
        while self._due and self._due[0][0] <= now and not self.ended:
            _, _, reply, closes = heapq.heappop(self._due)
            out += reply
            self.ended = "fin" if closes else ""
        return out

    def client_closed(self) -> None:
        """The client ended it."""
        self.ended = "fin"
