"""Whose turn it is on a line.

Rule 1: a client's read goes before a poll, except that a poll which is late by a whole period goes
        after at most one client read: clients cannot stop the polls, polls cannot stop the clients.
Rule 2: of the polls, the one that was due first goes first; after its turn it is due one period
        after it was started, so that on a line too slow for its polls all periods stretch alike and
        a pause (suspend, a line that was down) is followed by one round, not by a burst.
Rule 3: a quarantined device has one poll, its probe, when its breaker says so.
Rule 4: identical reads that wait for one device are one read with several waiters; a waiter that
        leaves takes nothing from the others, and a read whose last waiter left is not made.
Rule 5: at most `limit` client reads wait; one that waited longer than `limit_s` is given up.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from enum import StrEnum

from gateway.core.health import Breaker
from gateway.core.site import Device, Outcome
from gateway.devices.plan import PlannedBlock
from gateway.errors import QueueFull


class Purpose(StrEnum):
    """What a transaction is for."""

    CLIENT = "client"
    POLL = "poll"
    IDENTIFY = "identify"
    SERIAL_NUMBER = "serial_number"


class Waiter:
    """One asker of a client read; the `Ticket` it holds."""

    __slots__ = ("_done",)

    def __init__(self, done: Callable[[Outcome], None]) -> None:
        self._done: Callable[[Outcome], None] | None = done

    @property
    def left(self) -> bool:
        """Whether the asker is gone."""
        return self._done is None

    def cancel(self) -> None:
        """See `core.site.Ticket`."""
        self._done = None

    def finish(self, outcome: Outcome) -> None:
        """Tell the asker, once, unless it left."""
        done, self._done = self._done, None
        if done is not None:
            done(outcome)


@dataclass(slots=True, eq=False)
class ClientRead:
    """A read that clients wait for."""

    device: Device
    pdu: bytes
    queued_at: float
    attempts: int = 0
    waiters: list[Waiter] = field(default_factory=list)

    @property
    def wanted(self) -> bool:
        """Whether anybody still waits."""
        return any(not waiter.left for waiter in self.waiters)


@dataclass(slots=True, eq=False)
class PollItem:
    """One recurring (or one-time) read of a device."""

    device: Device
    purpose: Purpose
    pdu: bytes
    block: PlannedBlock | None
    period_s: float | None  # None: done once, then dropped
    due: float
    misses: int = 0  # attempts in a row that gave no data
    fresh: bool = False  # whether it gave data since the line was opened or the device came back

    def restart(self, now: float) -> None:
        """Due at once, and nothing is known: another unit may stand there now."""
        self.due = now
        self.misses = 0
        self.fresh = False


Job = ClientRead | PollItem


@dataclass(slots=True, eq=False)
class PollList:
    """The polls of one device and its breaker."""

    device: Device
    breaker: Breaker
    items: list[PollItem] = field(default_factory=list)

    def first(self) -> tuple[float, PollItem] | None:
        """The poll that is due first and when (rule 3); None when the device has none."""
        if not self.items:
            return None
        if self.breaker.probe_at is not None:
            probe = next((item for item in self.items if item.purpose is Purpose.POLL), self.items[0])
            return self.breaker.probe_at, probe
        item = min(self.items, key=lambda item: item.due)
        return item.due, item


class Scheduler:
    """The queue of one line."""

    def __init__(self, polls: Iterable[PollList], *, limit: int, limit_s: float) -> None:
        self._polls = tuple(polls)
        self._limit = limit
        self._limit_s = limit_s
        self._reads: deque[ClientRead] = deque()
        self._waiting: dict[tuple[int, bytes], ClientRead] = {}
        self._client_went_last = False

    def __len__(self) -> int:
        return len(self._reads)

    def add(self, device: Device, pdu: bytes, waiter: Waiter, now: float) -> None:
        """Queue a client read or join an identical one (rule 4); raises QueueFull (rule 5)."""
        key = (device.unit_id, pdu)
        read = self._waiting.get(key)
        if read is None:
            if len(self._reads) >= self._limit:
                self._forget_unwanted()
            if len(self._reads) >= self._limit:
                raise QueueFull
            read = ClientRead(device, pdu, now)
            self._waiting[key] = read
            self._reads.append(read)
        read.waiters.append(waiter)

    def retry(self, read: ClientRead) -> None:
        """Put a read that failed back at the head of the queue."""
        self._reads.appendleft(read)
        self._waiting.setdefault((read.device.unit_id, read.pdu), read)

    def expired(self, now: float) -> list[ClientRead]:
        """Take out the reads that waited too long (rule 5)."""
        out: list[ClientRead] = []
        while self._reads and self._reads[0].queued_at + self._limit_s <= now:
            out.append(self._take())
        return out

    def next_expiry(self) -> float | None:
        """When the oldest client read will have waited too long."""
        return self._reads[0].queued_at + self._limit_s if self._reads else None

    def drain(self) -> list[ClientRead]:
        """Take out all client reads: the line is down."""
        out = list(self._reads)
        self._reads.clear()
        self._waiting.clear()
        return out

    def take_device(self, device: Device) -> list[ClientRead]:
        """Take out the client reads of one device: it was quarantined."""
        out = [read for read in self._reads if read.device is device]
        for read in out:
            self._reads.remove(read)
            self._waiting.pop((read.device.unit_id, read.pdu), None)
        return out

    def next_due(self, now: float) -> float | None:
        """When there is something to do; `now` or earlier: at once. None: never."""
        if any(read.wanted for read in self._reads):
            return now
        firsts = [first[0] for polls in self._polls if (first := polls.first()) is not None]
        return min(firsts, default=None)

    def next(self, now: float) -> Job | None:
        """Take the job whose turn it is at `now`, or None (rules 1 and 2)."""
        self._forget_unwanted_head()
        poll = self._due_poll(now)
        if self._reads:
            overdue = poll is not None and poll[0] + (poll[1].period_s or 0.0) <= now
            if not (overdue and self._client_went_last):
                self._client_went_last = True
                return self._take()
        self._client_went_last = False
        return poll[1] if poll is not None else None

    def _due_poll(self, now: float) -> tuple[float, PollItem] | None:
        best: tuple[float, PollItem] | None = None
        for polls in self._polls:
            first = polls.first()
            if first is not None and first[0] <= now and (best is None or first[0] < best[0]):
                best = first
        return best

    def _take(self) -> ClientRead:
        read = self._reads.popleft()
        if self._waiting.get((read.device.unit_id, read.pdu)) is read:
            del self._waiting[(read.device.unit_id, read.pdu)]
        return read

    def _forget_unwanted_head(self) -> None:
        while self._reads and not self._reads[0].wanted:
            self._take()

    def _forget_unwanted(self) -> None:
        for _ in range(len(self._reads)):
            read = self._take()
            if read.wanted:
                self._reads.append(read)
                self._waiting[(read.device.unit_id, read.pdu)] = read
