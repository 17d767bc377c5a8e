"""A seeded medium that spoils what the wire carries: one object for virtual time and for a pty.

Rule 1: for each request every kind of fault is drawn by its rate, or `force` says which; then the same seed and the
    same traffic give the same faults.
Rule 2: a device answers in order. A late reply holds back those that follow it from the same device; none overtakes.
Rule 3: what is made up cannot be right by chance: frames with a right CRC come from addresses of nobody, with
    functions that no request uses, or with a count that was not asked for. Everything else has a wrong CRC.
Rule 4: who owns the port is told of `CLOSE` and `UNPLUG` (`on_port_fault`); nothing of it happens here.
Rule 5: an echo that comes and goes leaves open what a copy of a write is. Do not mix `ECHO` with writes: let a line
    echo always or never.

`with chaos:` adds seed, faults and the last of what the wire carried to any error that leaves the block.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from random import Random
from types import TracebackType
from typing import Self

from gateway.modbus.crc import append_crc
from gateway.simulator.medium import Burst

STRANGERS = range(200, 248)
"""Addresses that no station of a line with chaos may have."""

_UNUSED_FUNCTIONS = (0x07, 0x08, 0x11, 0x14, 0x41, 0x87, 0x91)
_BYTE_COUNTED = (1, 2, 3, 4)
_MAX_FRAME = 256
_CHAR_S = 0.00115  # at 9600 baud; pauses of a split frame are longer than that on a faster line
_IN_REQUEST = 0.5  # how often a drop or a flip hits the request
_RIGHT_ONE_FOLLOWS = 0.5  # how often the right unit answers after a stranger


class Fault(StrEnum):
    """What may happen to one transaction."""

    SPLIT = "split"  # pauses of up to 16 ms inside the reply
    JOIN = "join"  # the reply is handed over in one piece, at its end
    DELAY = "delay"  # later than usual, within any sensible time-out
    DROP = "drop"  # the request or the reply is lost
    DUPLICATE = "duplicate"  # the reply comes twice
    LATE = "late"  # after the time-out, perhaps after several
    NOISE_BEFORE = "noise_before"
    NOISE_AFTER = "noise_after"
    BIT_FLIP = "bit_flip"  # in the request or in the reply
    WRONG_UNIT = "wrong_unit"  # a stranger answers, sometimes before the right one
    WRONG_FUNCTION = "wrong_function"
    WRONG_COUNT = "wrong_count"
    ECHO = "echo"  # the client hears its own request
    TRUNCATE = "truncate"  # the reply ends early
    SILENCE = "silence"  # the device hears nothing for some seconds
    CLOSE = "close"  # the port hangs up and is there again
    UNPLUG = "unplug"  # the port goes away for a while


PORT_FAULTS = frozenset({Fault.CLOSE, Fault.UNPLUG})
LINE_FAULTS = frozenset(Fault) - PORT_FAULTS


def all_at(rate: float, *, but: frozenset[Fault] = PORT_FAULTS) -> dict[Fault, float]:
    """The same rate for every kind, except those in `but`."""
    return {fault: rate for fault in Fault if fault not in but}


@dataclass(frozen=True, slots=True)
class Spans:
    """How long things take that are drawn: (least, most) seconds."""

    delay_s: tuple[float, float] = (0.005, 0.25)
    late_s: tuple[float, float] = (0.5, 4.0)
    silence_s: tuple[float, float] = (0.5, 8.0)


@dataclass(frozen=True, slots=True)
class _Trial:
    """What happens to one transaction; `for_s` None: drawn."""

    faults: frozenset[Fault]
    in_request: bool  # which of the two frames is dropped or flipped
    for_s: float | None = None


_CLEAN = _Trial(frozenset(), in_request=False)


class Chaos:
    """A `Medium` that spoils frames; `rates` gives the probability of each kind for one request."""

    def __init__(
        self,
        seed: int,
        rates: Mapping[Fault, float] | None = None,
        *,
        spans: Spans | None = None,
        on_port_fault: Callable[[Fault], None] | None = None,
        log_size: int = 120,
    ) -> None:
        self.seed = seed
        self.counts: Counter[Fault] = Counter()
        self.on_port_fault = on_port_fault
        self._rng = Random(seed)  # noqa: S311  # a test must repeat itself
        self._rates = tuple((fault, rate) for fault, rate in (rates or {}).items() if rate > 0)
        self._spans = spans or Spans()
        self._forced: deque[_Trial] = deque()
        self._trial = _CLEAN
        self._free_at: dict[int, float] = {}  # address → when its last reply is under way
        self._deaf_until: dict[int, float] = {}
        self._log: deque[tuple[float, str, bytes, str]] = deque(maxlen=log_size)

    def force(self, *faults: Fault, for_s: float | None = None, in_request: bool = False) -> None:
        """Let these faults, and no drawn ones, happen to a coming request; calls queue up, one request each.

        `for_s` is how late, delayed or silent (else drawn); `in_request` which frame is dropped or flipped.
        """
        self._forced.append(_Trial(frozenset(faults), in_request, for_s))

    def stop(self) -> None:
        """No more faults are drawn or forced; what is late stays late."""
        self._rates = ()
        self._forced.clear()

    def report(self) -> str:
        """Seed, faults so far and the last frames, for people."""
        counts = " ".join(f"{fault}={count}" for fault, count in sorted(self.counts.items())) or "none"
        lines = [f"{at:14.4f} {what:8} {data.hex(' ')} {faults}".rstrip() for at, what, data, faults in self._log]
        return "\n".join((f"chaos seed={self.seed} faults: {counts}", *lines))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is not None:
            error.add_note(self.report())

    def echo(self, frame: bytes, started_at: float) -> Sequence[Burst]:
        """See `Medium.echo`; a transaction starts here."""
        self._trial = self._forced.popleft() if self._forced else self._draw()
        for fault in sorted(PORT_FAULTS & self._trial.faults):
            if self.on_port_fault is not None:
                self.counts[fault] += 1
                self.on_port_fault(fault)
        if Fault.ECHO not in self._trial.faults:
            return ()
        self._note(started_at, "echo", frame, Fault.ECHO)
        return (Burst(started_at, frame),)

    def request(self, frame: bytes, ended_at: float) -> bytes:
        """See `Medium.request`."""
        faults = self._trial.faults
        if Fault.SILENCE in faults:
            self._deaf_until[frame[0]] = ended_at + self._seconds(self._spans.silence_s)
            self._note(ended_at, "request", frame, Fault.SILENCE)
            return b""
        if ended_at < self._deaf_until.get(frame[0], -math.inf):
            self._note(ended_at, "unheard", frame)
            return b""
        if self._trial.in_request and Fault.DROP in faults:
            self._note(ended_at, "request", frame, Fault.DROP)
            return b""
        if self._trial.in_request and Fault.BIT_FLIP in faults:
            self._note(ended_at, "request", frame, Fault.BIT_FLIP)
            return self._flipped(frame)
        self._note(ended_at, "request", frame)
        return frame

    def reply(self, frame: bytes, starts_at: float) -> Sequence[Burst]:
        """See `Medium.reply`."""
        faults = self._trial.faults
        address = frame[0]
        if Fault.DROP in faults and not self._trial.in_request:
            self._note(starts_at, "reply", frame, Fault.DROP)
            return ()
        at = starts_at
        happened: list[Fault] = []
        for fault, span in ((Fault.DELAY, self._spans.delay_s), (Fault.LATE, self._spans.late_s)):
            if fault in faults:
                at += self._seconds(span)
                happened.append(fault)
        at = max(at, self._free_at.get(address, -math.inf))  # rule 2
        data = frame
        for fault, spoil in self._spoilers():
            if fault in faults and not (fault is Fault.BIT_FLIP and self._trial.in_request):
                data, before = spoil(data), data
                if data != before:
                    happened.append(fault)
        bursts = self._surrounded(at, data, happened)
        if Fault.WRONG_UNIT in happened and self._rng.random() < _RIGHT_ONE_FOLLOWS:
            bursts.append(Burst(bursts[-1].at + 0.05, frame))
        self._free_at[address] = bursts[-1].at
        self._note(at, "reply", b"".join(burst.data for burst in bursts), *happened)
        return bursts

    def _surrounded(self, at: float, data: bytes, happened: list[Fault]) -> list[Burst]:
        """One frame as it goes on the wire: with noise, in pieces, twice."""
        bursts: list[Burst] = []
        if Fault.NOISE_BEFORE in self._trial.faults:
            happened.append(Fault.NOISE_BEFORE)
            bursts.append(Burst(at, self._noise(data, 300)))
        if Fault.SPLIT in self._trial.faults:
            happened.append(Fault.SPLIT)
            bursts += self._pieces(at, data)
        else:
            whole = Fault.JOIN in self._trial.faults
            happened += [Fault.JOIN] * whole
            bursts.append(Burst(at, data, whole=whole))
        last = bursts[-1].at
        if Fault.DUPLICATE in self._trial.faults:
            happened.append(Fault.DUPLICATE)
            # Its first byte by itself: an adapter that has been idle keeps nothing back.
            bursts += [Burst(last, data[:1]), Burst(last, data[1:])]
        if Fault.NOISE_AFTER in self._trial.faults:
            happened.append(Fault.NOISE_AFTER)
            bursts.append(Burst(last + self._rng.uniform(0.0, 0.05), self._noise(data, 40)))
        return bursts

    def _pieces(self, at: float, data: bytes) -> list[Burst]:
        bursts = []
        while data:
            size = self._rng.randint(1, len(data))
            bursts.append(Burst(at, data[:size]))
            data = data[size:]
            at += size * _CHAR_S + self._rng.uniform(0.0, 0.016)
        return bursts

    def _draw(self) -> _Trial:
        rng = self._rng
        faults = frozenset(fault for fault, rate in self._rates if rng.random() < rate)
        return _Trial(faults, in_request=rng.random() < _IN_REQUEST) if faults else _CLEAN

    def _seconds(self, span: tuple[float, float]) -> float:
        return self._rng.uniform(*span) if self._trial.for_s is None else self._trial.for_s

    def _spoilers(self) -> tuple[tuple[Fault, Callable[[bytes], bytes]], ...]:
        return (
            (Fault.WRONG_UNIT, self._of_stranger),
            (Fault.WRONG_FUNCTION, self._of_function),
            (Fault.WRONG_COUNT, self._of_count),
            (Fault.BIT_FLIP, self._flipped),
            (Fault.TRUNCATE, self._truncated),
        )

    def _flipped(self, frame: bytes) -> bytes:
        bit = self._rng.randrange(8 * len(frame))
        return frame[: bit >> 3] + bytes([frame[bit >> 3] ^ 1 << (bit & 7)]) + frame[(bit >> 3) + 1 :]

    def _truncated(self, frame: bytes) -> bytes:
        return frame[: self._rng.randint(1, len(frame) - 1)]

    def _of_stranger(self, frame: bytes) -> bytes:
        return append_crc(bytes([self._rng.choice(STRANGERS)]) + frame[1:-2])

    def _of_function(self, frame: bytes) -> bytes:
        return append_crc(frame[:1] + bytes([self._rng.choice(_UNUSED_FUNCTIONS)]) + frame[2:-2])

    def _of_count(self, frame: bytes) -> bytes:
        if frame[1] not in _BYTE_COUNTED or len(frame) < 7:
            return frame
        payload = frame[3:-2]
        step = 1 if frame[1] < 3 else 2
        if len(frame) + step <= _MAX_FRAME and (len(payload) <= step or self._rng.random() < 0.5):
            payload += payload[:step].ljust(step, b"\0")
        else:
            payload = payload[:-step]
        return append_crc(frame[:2] + bytes([len(payload)]) + payload)

    def _noise(self, frame: bytes, most: int) -> bytes:
        """Random bytes, or such as look like the head of the reply."""
        size = self._rng.randint(1, most)
        if self._rng.random() < 0.3:
            head = frame[: self._rng.randint(1, 3)]
            return (head * size)[:size]
        return self._rng.randbytes(size)

    def _note(self, at: float, what: str, data: bytes, *faults: Fault) -> None:
        self.counts.update(faults)
        self._log.append((at, what, data, ",".join(faults)))
