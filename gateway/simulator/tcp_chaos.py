"""What can go wrong with the replies of a Modbus TCP server: seeded, and never right by chance.

Rule 1: for each reply every kind of fault is drawn by its rate; then the same seed and traffic give the same faults.
Rule 2: what is made up cannot pass for an answer: a transaction id that the client does not wait for, a unit id of
    nobody, a function that nobody asked for, a count that was not asked for. Bytes are never changed under a right
    header: TCP has checksums, and Modbus TCP nothing beyond them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from enum import StrEnum
from random import Random

from gateway.modbus.mbap import Adu, encode
from gateway.modbus.pdu import exception_reply
from gateway.simulator.upstream import Piece

_STRANGERS = range(200, 248)
_UNUSED_FUNCTIONS = (0x07, 0x08, 0x11, 0x41, 0x87, 0x91)
_NO_LENGTHS = (b"\0\0", b"\0\1", b"\0\xff", b"\xff\xff")
_HEADER = 7


class TcpFault(StrEnum):
    """What may happen to one reply."""

    SPLIT = "split"  # in pieces, with pauses
    DELAY = "delay"  # later than usual; those behind it wait too
    LATE = "late"  # after any sensible time-out; those behind it do not wait
    LOST = "lost"  # never sent
    DUPLICATE = "duplicate"
    WRONG_TID = "wrong_tid"
    WRONG_UNIT = "wrong_unit"
    WRONG_FUNCTION = "wrong_function"
    WRONG_COUNT = "wrong_count"
    PROTOCOL_ID = "protocol_id"
    LENGTH = "length"
    GARBAGE = "garbage"  # random bytes before it
    HALF = "half"  # the rest never comes, nor anything else on the connection
    TORN = "torn"  # the rest never comes, what follows it does
    HALF_CLOSE = "half_close"  # the rest never comes, the connection ends
    FIN = "fin"  # the connection ends in its place
    RESET = "reset"
    FIN_AFTER = "fin_after"  # the connection ends behind it
    BUSY = "busy"  # exception 06
    NO_PATH = "no_path"  # exception 0A
    NO_ANSWER = "no_answer"  # exception 0B


EXCEPTIONS = {TcpFault.BUSY: 0x06, TcpFault.NO_PATH: 0x0A, TcpFault.NO_ANSWER: 0x0B}


class TcpChaos:
    """A `Spoiler`; `rates` gives the probability of each kind for one reply."""

    def __init__(
        self,
        seed: int,
        rates: Mapping[TcpFault, float],
        *,
        delay_s: tuple[float, float] = (0.01, 0.3),
        late_s: tuple[float, float] = (0.4, 3.0),
    ) -> None:
        self.seed = seed
        self.counts: Counter[TcpFault] = Counter()
        self._rng = Random(seed)  # noqa: S311  # a test must repeat itself
        self._rates = {fault: rate for fault, rate in rates.items() if rate > 0}
        self._delay_s = delay_s
        self._late_s = late_s
        self._behind = 0.0  # replies come no sooner: one before was delayed

    def stop(self) -> None:
        """No more faults; what is late stays late."""
        self._rates.clear()

    def reply(self, request: Adu, reply: bytes, at: float, waiting: frozenset[int]) -> Sequence[Piece]:
        """See `Spoiler.reply`."""
        rng = self._rng
        faults = {fault for fault, rate in self._rates.items() if rng.random() < rate}
        self.counts.update(faults)
        at = max(at, self._behind)
        if TcpFault.DELAY in faults:
            at = self._behind = at + rng.uniform(*self._delay_s)
        if TcpFault.LATE in faults:
            at += rng.uniform(*self._late_s)
        if faults & {TcpFault.FIN, TcpFault.RESET}:
            return (Piece(at, b"", "reset" if TcpFault.RESET in faults else "fin"),)
        if TcpFault.LOST in faults:
            return ()
        data = self._spoilt(request, reply, faults, waiting)
        if faults & {TcpFault.HALF, TcpFault.HALF_CLOSE}:
            half = data[: rng.randrange(1, len(data))]
            return (Piece(at, half, "fin" if TcpFault.HALF_CLOSE in faults else "stuck"),)
        if TcpFault.TORN in faults:
            data = data[: rng.randrange(1, len(data))]
        pieces = [Piece(at, data)]
        if TcpFault.SPLIT in faults:
            pieces = self._pieces(data, at)
            self._behind = pieces[-1].at
        if TcpFault.DUPLICATE in faults:
            pieces.append(Piece(pieces[-1].at + rng.choice((0.0, 0.05)), data))
        if TcpFault.FIN_AFTER in faults:
            pieces.append(Piece(pieces[-1].at, b"", "fin"))
        return pieces

    def _spoilt(self, request: Adu, reply: bytes, faults: set[TcpFault], waiting: frozenset[int]) -> bytes:
        kinds: dict[TcpFault, Callable[[bytes], bytes]] = {
            TcpFault.WRONG_COUNT: self._of_count,
            TcpFault.WRONG_FUNCTION: self._of_function,
            TcpFault.WRONG_UNIT: lambda data: data[:6] + bytes([self._rng.choice(_STRANGERS)]) + data[7:],
            TcpFault.WRONG_TID: lambda data: self._tid(waiting).to_bytes(2, "big") + data[2:],
            TcpFault.PROTOCOL_ID: lambda data: data[:2] + self._rng.randrange(1, 0x10000).to_bytes(2, "big") + data[4:],
            TcpFault.LENGTH: lambda data: data[:4] + self._rng.choice(_NO_LENGTHS) + data[6:],
            TcpFault.GARBAGE: lambda data: self._garbage() + data,
        }
        for fault, code in EXCEPTIONS.items():
            if fault in faults:
                reply = encode(request.tid, request.unit, exception_reply(request.pdu[0], code))
        for fault, spoil in kinds.items():
            if fault in faults:
                reply = spoil(reply)
        return reply

    def _tid(self, waiting: frozenset[int]) -> int:
        while True:
            tid = self._rng.randrange(0x10000)
            if tid not in waiting:
                return tid

    def _garbage(self) -> bytes:
        """Random bytes whose second word is no protocol id of Modbus."""
        return self._rng.randbytes(2) + b"\x5a" + self._rng.randbytes(self._rng.randrange(1, 40))

    def _of_function(self, data: bytes) -> bytes:
        return data[:_HEADER] + bytes([self._rng.choice(_UNUSED_FUNCTIONS)]) + data[_HEADER + 1 :]

    def _of_count(self, data: bytes) -> bytes:
        tid, unit, pdu = int.from_bytes(data[:2], "big"), data[6], data[_HEADER:]
        if pdu[0] > 4 or len(pdu) > 250:
            return self._of_function(data)
        return encode(tid, unit, pdu[:1] + bytes([pdu[1] + 2]) + pdu[2:] + b"\0\0")

    def _pieces(self, data: bytes, at: float) -> list[Piece]:
        pieces = []
        while data:
            size = self._rng.randint(1, len(data))
            pieces.append(Piece(at, data[:size]))
            data, at = data[size:], at + self._rng.uniform(0.0, 0.05)
        return pieces
