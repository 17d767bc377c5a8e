"""A serial line in virtual time, seen from the client's end.

Rules (Modbus over Serial Line V1.02 §2.5.1.1, one byte = start, data, parity and stop bits):

1. Bytes take their time in both directions: the client's bytes leave its UART one after the other,
   and the client hears a reply byte when its last bit has arrived, never earlier.
2. A request frame ends when 3.5 characters of silence followed its last byte. Bytes that come before
   that belong to the same frame; a frame of more than 256 bytes or with a wrong CRC is heard by nobody.
3. The station with the frame's address answers after its turnaround. It works on one request at a
   time; requests that come meanwhile wait. Two stations with one address answer at once, and a 0 bit wins.
4. Broadcasts (address 0) are answered by nobody and executed by nobody.
5. Silence before a request shorter than 3.5 characters is a gap violation, a request while a reply is
   on the wire (or the reverse) a collision. Both are counted and, on this line, survive.

The line does no input or output and never reads a clock: `receive` bytes, ask `next_event`, `take` at that time.
"""

from __future__ import annotations

import heapq
import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import zip_longest
from typing import Protocol

from gateway.modbus.crc import append_crc, crc_ok
from gateway.modbus.rtu import Timing
from gateway.simulator.medium import Burst, CleanMedium, Medium

_MAX_FRAME = 256
_MIN_FRAME = 4
_TOLERANCE_S = 1e-6  # rounding of monotonic clocks with many digits before the point


class Station(Protocol):
    """What hangs on a line: answers PDUs that are addressed to it."""

    @property
    def address(self) -> int:
        """The address it listens to now."""
        ...

    @property
    def turnaround_s(self) -> float:
        """Time between the end of a request (3.5 characters included) and the first bit of its answer."""
        ...

    def handle(self, pdu: bytes, now: float) -> bytes | None:
        """The reply PDU, or None when it does not answer."""
        ...


@dataclass(slots=True)
class LineCounters:
    """What happened on the wire since start."""

    requests: int = 0  # frames with a right CRC
    replies: int = 0
    unanswered: int = 0  # requests nobody answered, broadcasts not counted
    broadcasts: int = 0
    bad_frames: int = 0  # too short, too long or with a wrong CRC
    gap_violations: int = 0
    collisions: int = 0
    shortest_gap_s: float = math.inf  # silence before a request, the first one aside
    bytes_in: int = 0
    bytes_out: int = 0
    busy_s: float = 0.0  # wire time of all bytes
    gaps_s: float = 0.0  # the 3.5 characters that each frame needs after it


@dataclass(slots=True)
class _Transmission:
    """A reply on the wire."""

    start: float
    data: bytes
    whole: bool
    taken: int = 0


@dataclass(order=True, slots=True)
class _Pending:
    """A burst whose time has not come."""

    at: float
    number: int
    burst: Burst = field(compare=False)


class SimulatedLine:
    """Stations on one half-duplex line.

    `wake_bytes` is how many reply bytes may gather before `next_event` names a time; `take` is exact at any time.
    """

    def __init__(
        self,
        stations: Sequence[Station],
        *,
        timing: Timing | None = None,
        medium: Medium | None = None,
        wake_bytes: int = 16,
    ) -> None:
        self.stations = list(stations)
        self.timing = timing or Timing.of(9600, 8, "N", 2)
        self.medium: Medium = medium or CleanMedium()
        self.counters = LineCounters()
        self._wake_bytes = wake_bytes
        self._frame = bytearray()
        self._in_end = -math.inf  # end of the client's last byte
        self._out_end = -math.inf  # end of the last reply byte that is on the wire
        self._pending: list[_Pending] = []
        self._number = 0
        self._wire: deque[_Transmission] = deque()
        self._busy_until: dict[int, float] = {}
        self._corrupt = 0
        self._delays: deque[float] = deque()

    def corrupt_replies(self, count: int) -> None:
        """Flip one bit in the middle of each of the next `count` replies."""
        self._corrupt += count

    def delay_reply(self, seconds: float) -> None:
        """Send the next reply that much later; calls add up to one delay a reply."""
        self._delays.append(seconds)

    def clear(self) -> None:
        """Forget all that is on its way, in both directions: the client's adapter was away."""
        self._frame.clear()
        self._pending.clear()
        self._wire.clear()
        self._busy_until.clear()
        self._in_end = self._out_end = -math.inf

    def use_ratio(self, elapsed_s: float) -> float:
        """Share of `elapsed_s` in which the wire carried bytes or the gaps they need."""
        return (self.counters.busy_s + self.counters.gaps_s) / elapsed_s if elapsed_s > 0 else 0.0

    def receive(self, data: bytes, now: float) -> None:
        """Take bytes that the client wrote at `now`."""
        if not data:
            return
        self._settle(now)
        start = max(now, self._in_end)
        if not self._frame:
            self._measure_gap(start)
        duration = self.timing.wire_s(len(data))
        self._frame += data
        self._in_end = start + duration
        self.counters.bytes_in += len(data)
        self.counters.busy_s += duration

    def next_event(self) -> float | None:
        """When the line next has something to do or to give; None while it is silent."""
        times = []
        if self._frame:
            times.append(self._in_end + self.timing.gap_s)
        if self._pending:
            times.append(self._pending[0].at)
        if self._wire:
            head = self._wire[0]
            wanted = len(head.data) if head.whole else min(len(head.data), head.taken + self._wake_bytes)
            times.append(head.start + self.timing.wire_s(wanted))
        return min(times, default=None)

    def take(self, now: float) -> bytes:
        """The reply bytes that reached the client since the last call."""
        self._settle(now)
        arrived = bytearray()
        while self._wire:
            head = self._wire[0]
            there = min(len(head.data), math.floor((now - head.start + _TOLERANCE_S) / self.timing.char_s))
            if there > head.taken and not (head.whole and there < len(head.data)):
                arrived += head.data[head.taken : there]
                head.taken = there
            if head.taken < len(head.data):
                break
            self._wire.popleft()
        return bytes(arrived)

    def _measure_gap(self, start: float) -> None:
        silence = start - max(self._in_end, self._out_end)
        if silence < -_TOLERANCE_S:
            self.counters.collisions += 1
            return
        if silence < self.timing.gap_s - _TOLERANCE_S:
            self.counters.gap_violations += 1
        self.counters.shortest_gap_s = min(self.counters.shortest_gap_s, silence)

    def _settle(self, now: float) -> None:
        """Let everything happen that is due by `now`, in its order."""
        while True:
            frame_due = self._in_end + self.timing.gap_s if self._frame else math.inf
            burst_due = self._pending[0].at if self._pending else math.inf
            if min(frame_due, burst_due) > now + _TOLERANCE_S:
                return
            if frame_due <= burst_due:
                self._frame_ended(frame_due)
            else:
                self._transmit(heapq.heappop(self._pending).burst)

    def _transmit(self, burst: Burst) -> None:
        start = max(burst.at, self._out_end)
        if self._frame and self._in_end > start + _TOLERANCE_S:
            self.counters.collisions += 1
        duration = self.timing.wire_s(len(burst.data))
        self._wire.append(_Transmission(start, burst.data, burst.whole))
        self._out_end = start + duration
        self.counters.bytes_out += len(burst.data)
        self.counters.busy_s += duration
        self.counters.gaps_s += self.timing.gap_s

    def _frame_ended(self, now: float) -> None:
        frame = bytes(self._frame)
        self._frame.clear()
        self.counters.gaps_s += self.timing.gap_s
        self._schedule(self.medium.echo(frame, self._in_end - self.timing.wire_s(len(frame))))
        heard = self.medium.request(frame, self._in_end)
        if not heard:
            return
        if not _MIN_FRAME <= len(heard) <= _MAX_FRAME or not crc_ok(heard):
            self.counters.bad_frames += 1
            return
        self.counters.requests += 1
        address, pdu = heard[0], heard[1:-2]
        if address == 0:
            self.counters.broadcasts += 1
            return
        replies = [self._ask(station, pdu, now) for station in self.stations if station.address == address]
        answered = [reply for reply in replies if reply is not None]
        if not answered:
            self.counters.unanswered += 1
            return
        self._reply(min(at for at, _ in answered), _superpose([frame for _, frame in answered]))

    def _ask(self, station: Station, pdu: bytes, now: float) -> tuple[float, bytes] | None:
        """When the station's reply starts and its frame; None when it does not answer."""
        started = max(now, self._busy_until.get(id(station), -math.inf))
        address = station.address  # a reset may change it, and the reply still carries the old one
        reply = station.handle(pdu, started)
        if reply is None:
            return None
        frame = append_crc(bytes([address]) + reply)
        at = started + station.turnaround_s
        self._busy_until[id(station)] = at + self.timing.wire_s(len(frame))
        return at, frame

    def _reply(self, at: float, frame: bytes) -> None:
        self.counters.replies += 1
        if self._delays:
            at += self._delays.popleft()
        if self._corrupt:
            self._corrupt -= 1
            middle = len(frame) // 2
            frame = frame[:middle] + bytes([frame[middle] ^ 0x10]) + frame[middle + 1 :]
        self._schedule(self.medium.reply(frame, at))

    def _schedule(self, bursts: Sequence[Burst]) -> None:
        for burst in bursts:
            if burst.data:
                self._number += 1
                heapq.heappush(self._pending, _Pending(burst.at, self._number, burst))


def _superpose(frames: Sequence[bytes]) -> bytes:
    """What the wire carries when several stations talk at once: a 0 bit wins over the idle 1."""
    merged = frames[0]
    for frame in frames[1:]:
        merged = bytes(a & b for a, b in zip_longest(merged, frame, fillvalue=0xFF))
    return merged
