"""The bytes of one transaction: from what the line gave to the reply, without a notion of time.

Rule 1: the outcome is a function of the bytes in their order; how they were split does not matter. So old bytes
    are dropped at fixed counts, and everything left of the reply is explained only when the end is known.
Rule 2: at most 512 bytes are kept, of any flood.
Rule 3, echo: a copy of the request is skipped. Where a copy would pass for the reply (functions 05 and 06, some
    coil reads), the first copy is the echo unless the line is known to have none, and only the second is the
    reply: a silent device on an echoing line is never taken for a success.
"""

from __future__ import annotations

from enum import Enum

from gateway.modbus.frames import EXCEPTION_FRAME, MAX_FRAME, Exchange, Found, Survey

MAX_BUFFER = 2 * MAX_FRAME
"""Bytes kept while a reply is waited for."""


class Echo(Enum):
    """Whether the line gives our own requests back."""

    UNKNOWN = "unknown"
    ABSENT = "absent"
    PRESENT = "present"


class Collector:
    """Collects bytes until the reply to one exchange is among them.

    `seen` tells what the other bytes were; it is complete after `take` returned a reply or `close` was called.
    """

    __slots__ = ("_buffer", "_echo", "_echo_taken", "_first", "_floor", "_walked", "exchange", "seen")

    def __init__(self, exchange: Exchange, echo: Echo) -> None:
        self.exchange = exchange
        self.seen = Survey()
        self._echo = echo
        self._echo_taken = False
        self._buffer = bytearray()
        self._floor = 0  # the reply starts no sooner
        self._walked = 0  # bytes before are explained
        self._first = False  # the reply was the first thing on the line

    @property
    def pending(self) -> int:
        """Bytes kept; at most 512."""
        return len(self._buffer)

    def take(self, data: bytes) -> tuple[bytes, int] | None:
        """Take bytes; returns the reply PDU that they complete and how many bytes came after its frame."""
        taken = 0
        while taken < len(data):
            known = len(self._buffer)
            piece = data[taken : taken + MAX_BUFFER - known]
            taken += len(piece)
            self._buffer += piece
            found = self._search(known)
            if found is not None:
                self._explain(found.start)
                self._first = found.start == 0
                pdu = bytes(self._buffer[found.start + 1 : found.end - 2])
                return pdu, len(self._buffer) - found.end + len(data) - taken
            if len(self._buffer) == MAX_BUFFER:
                self._shed()
        return None

    def damaged(self) -> bool:
        """Whether the reply's own head and full size are there, with a wrong CRC."""
        seen, _ = self.exchange.survey(self._buffer, self._walked, len(self._buffer), last=True)
        return seen.damaged > 0

    def close(self) -> Survey:
        """Nothing more will come: explain all bytes that are left."""
        self._explain(len(self._buffer))
        return self.seen

    def echo_after(self, *, replied: bool) -> Echo:
        """What is known about echo when the transaction has ended.

        Only what cannot be a reply teaches: a lone copy of a write may be either. And a reply that was not the
        first thing on the line does not prove that there is no echo: the noise before it may be a damaged one.
        """
        if self.exchange.echo_is_reply:
            return Echo.PRESENT if replied and self._echo_taken else self._echo
        if self.seen.echoes:
            return Echo.PRESENT
        if replied and self._first:
            return Echo.UNKNOWN if self._echo is Echo.PRESENT else Echo.ABSENT
        return self._echo

    def bytes_due(self) -> int:
        """How many more bytes the reply needs at least, if what looks like its head is its head."""
        buffer, sent = self._buffer, self.exchange.sent
        if self._echo is Echo.PRESENT and len(buffer) < len(sent) and sent.startswith(buffer):
            return len(sent) - len(buffer) + EXCEPTION_FRAME
        start = max(self._floor, len(sent) if buffer.startswith(sent) else 0)
        for at in range(start, len(buffer)):
            missing = at + self.exchange.size_at(buffer, at) - len(buffer)
            if missing > 0:
                return missing
        return EXCEPTION_FRAME

    def _search(self, known: int) -> Found | None:
        exchange = self.exchange
        found = exchange.find(self._buffer, self._floor, known)
        if found is None or self._echo_taken or not exchange.echo_is_reply or self._echo is Echo.ABSENT:
            return found
        if self._buffer[found.start : found.end] != exchange.sent:
            return found
        self._echo_taken = True
        self._floor = found.end
        return exchange.find(self._buffer, self._floor, known)

    def _explain(self, end: int) -> None:
        seen, self._walked = self.exchange.survey(self._buffer, self._walked, end, last=True)
        self.seen.add(seen)

    def _shed(self) -> None:
        """Explain and drop the older half of a full buffer: frames that start there were all decided."""
        seen, stopped = self.exchange.survey(self._buffer, self._walked, len(self._buffer), last=False)
        self.seen.add(seen)
        del self._buffer[:MAX_FRAME]
        self._walked = stopped - MAX_FRAME
        self._floor = max(0, self._floor - MAX_FRAME)
