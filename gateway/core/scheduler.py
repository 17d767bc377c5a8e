"""Whose turn it is on a line.

Rule 1: lanes by precedence: slave control, other writes, client reads, polls, background (requests.Lane).
Rule 2: ageing, so that no lane starves: a lane whose head has waited longer than the lane's patience goes next
        after one turn of a higher lane; of several such lanes the one passed over most. Polls have no patience with
        clients: one that is due waits for one read of theirs at most. For writes it waits a whole period.
Rule 3: of the polls, the one that was due first goes first; after its turn it is due one period after it was
        started, so that on a line too slow for its polls all periods stretch alike, and a pause (suspend, a line
        that was down) is followed by one round, not by a burst.
Rule 4: a quarantined device has one poll, its probe, when its breaker says so.
Rule 5: background reads go only when nothing else is to be done and they are over before the next poll is due, however
        long they wait. So that idle time which lies in pieces between the polls is of use, a background read that has
        waited for GATHER_S brings polls forward, each at most once in GATHER_S: then they follow one another.
Rule 6: client reads share the line fairly (fairness.py) and are joined where that saves line time (coalescing.py).
Rule 7: where a line carries several transactions at once, nothing is begun that must wait for one under way
        (under_way.py). A write that waits for its device lets no further read of that device begin.
Rule 8: when the next poll is due is looked up once and holds until then, or until who owns the polls says that they
        changed: a line that serves clients from memory and from far away asks it thousands of times a second.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from operator import itemgetter

from gateway.core.coalescing import Cost, join
from gateway.core.fairness import FairQueue
from gateway.core.health import Breaker
from gateway.core.requests import ClientRead, Lane, PollItem, Purpose, ReadTurn, Span, Turn, Waiter, WriteTurn
from gateway.core.site import Device
from gateway.core.turns import clients_of
from gateway.core.under_way import UnderWay
from gateway.devices.model import Space
from gateway.devices.plan import limit as protocol_limit
from gateway.errors import QueueFull
from gateway.modbus.pdu import ReadRequest

PATIENCE_S = {Lane.SLAVE_CONTROL: 0.0, Lane.WRITE: 0.5, Lane.CLIENT: 1.0}
GATHER_S = 30.0
SLAVE_TURNS = 4
"""How often slave control may go ahead of a lane that has waited too long."""


@dataclass(slots=True, eq=False)
class PollList:
    """The polls of one device, its breaker, and what was learnt about its limits."""

    device: Device
    breaker: Breaker
    items: list[PollItem] = field(default_factory=list)
    most: dict[Space, int] = field(default_factory=dict)  # space → the longest read not yet refused

    def first(self) -> tuple[float, PollItem] | None:
        """The poll that is due first and when (rule 4); None when the device has none that is not under way."""
        if self.breaker.probe_at is not None:
            items = [item for item in self.items if not item.under_way]
            probe = next((item for item in items if item.purpose is Purpose.POLL), items[0] if items else None)
            return None if probe is None else (self.breaker.probe_at, probe)
        first: PollItem | None = None
        for item in self.items:
            if not item.under_way and (first is None or item.due < first.due):
                first = item
        return None if first is None else (first.due, first)

    def drop(self, item: PollItem) -> None:
        """It is not asked any more; when the device was restarted while it was under way, it is gone already."""
        if item in self.items:
            self.items.remove(item)

    def most_in(self, space: Space) -> int:
        """The longest read of this space that makes sense."""
        return min(protocol_limit(space), self.most.get(space, protocol_limit(space)))

    def refused(self, space: Space, count: int) -> None:
        """The device did not take a read of `count`."""
        self.most[space] = max(1, min(self.most_in(space), count - 1))


class Scheduler:
    """The queues of one line."""

    def __init__(
        self,
        polls: Iterable[PollList],
        *,
        limit: int,
        limit_s: float,
        cost: Cost,
        now: float,
        under_way: UnderWay | None = None,
    ) -> None:
        self._under_way = under_way if under_way is not None else UnderWay()
        self._polls = {list_.device.unit_id: list_ for list_ in polls}
        self._limit = limit
        self._cost = cost
        self._clients = FairQueue(Lane.CLIENT, limit=limit, limit_s=limit_s)
        self._background = FairQueue(Lane.BACKGROUND, limit=limit, limit_s=float("inf"))
        self._writes: dict[Lane, deque[WriteTurn]] = {Lane.SLAVE_CONTROL: deque(), Lane.WRITE: deque()}
        self._served_at = dict.fromkeys(Lane, now)
        self._passed = dict.fromkeys(Lane, 0)
        self._no_poll_before = -math.inf  # as far as is known

    def __len__(self) -> int:
        return len(self._clients) + len(self._background) + sum(map(len, self._writes.values()))

    def adjust(self, *, limit: int, limit_s: float) -> None:
        """Other limits from now on."""
        self._limit = limit
        self._clients.adjust(limit=limit, limit_s=limit_s)
        self._background.adjust(limit=limit, limit_s=float("inf"))

    def add_read(self, device: Device, pdu: bytes, span: Span | None, waiter: Waiter, lane: Lane) -> ClientRead | None:
        """Queue a read; see FairQueue.add."""
        return self._queue(lane).add(device, pdu, span, waiter)

    def add_write(self, write: WriteTurn) -> None:
        """Queue a write; raises QueueFull."""
        queue = self._writes[write.lane]
        if len(queue) >= self._limit:
            raise QueueFull
        queue.append(write)

    def polls_changed(self) -> None:
        """A poll may be due sooner than it was (rule 8)."""
        self._no_poll_before = -math.inf

    def retry(self, read: ClientRead) -> None:
        """Put a read that failed back at the head of its queue."""
        self._queue(read.lane).retry(read)

    def charge(self, turn: ReadTurn, seconds: float) -> None:
        """Book the line time of a finished read on its clients."""
        self._queue(turn.lane).charge(clients_of(turn), seconds)

    def expired(self, now: float) -> list[Waiter]:
        """Take out the askers of client reads that waited too long."""
        return self._clients.expired(now)

    def next_expiry(self) -> float | None:
        """When the oldest client read will have waited too long."""
        return self._clients.next_expiry()

    def drain(self, device: Device | None = None) -> list[Waiter]:
        """Take out all requests (the line is down), or those of one device (it was quarantined)."""
        reads = self._clients.drain(device) + self._background.drain(device)
        waiters = [waiter for read in reads for waiter in read.waiters]
        for lane, queue in self._writes.items():
            waiters += [write.waiter for write in queue if device is None or write.device is device]
            self._writes[lane] = deque(write for write in queue if device is not None and write.device is not device)
        return waiters

    def next_due(self, now: float) -> float | None:
        """When there is something to do; `now` or earlier: at once. None: never."""
        if any(self._write_head(lane) for lane in self._writes) or self._clients.head(self._ready) is not None:
            return now
        due = self._next_poll_due(now)
        background = self._background.head(self._ready)
        if background is None or (due is not None and due <= now):
            return due
        if self._fits(background, now) or self._early(background, now) is not None:
            return now
        gather_at = self._gather_at(background)
        return due if due is None or gather_at <= now else min(due, gather_at)

    def next(self, now: float) -> Turn | None:
        """Take the turn whose time it is at `now`, or None."""
        ready: dict[Lane, float] = {}  # lane → when its head will have waited too long
        for lane, queue in self._writes.items():
            write = self._write_head(lane) if queue else None
            if write is not None:
                ready[lane] = write.queued_at + PATIENCE_S[lane]
        client = self._clients.head(self._ready)
        if client is not None:
            ready[Lane.CLIENT] = max(client.queued_at, self._served_at[Lane.CLIENT]) + PATIENCE_S[Lane.CLIENT]
        poll = self._due_poll(now)
        if poll is not None:
            ready[Lane.POLL] = poll[0]
        if not ready:
            return self._when_idle(now)
        lane = self._choose(ready, now, poll_grace_s=(poll[1].period_s or 0.0) if poll is not None else 0.0)
        self._served_at[lane] = now
        if lane in self._writes:
            write = self._write_head(lane)
            assert write is not None
            self._writes[lane].remove(write)
            return write
        if lane is Lane.POLL:
            assert poll is not None
            return poll[1]
        assert client is not None
        return self._join(client)

    def _when_idle(self, now: float) -> Turn | None:
        """Rule 5."""
        background = self._background.head(self._ready)
        if background is None:
            return None
        if self._fits(background, now):
            self._served_at[Lane.BACKGROUND] = now
            return self._join(background)
        early = self._early(background, now)
        if early is not None:
            early.early_at = now
        return early

    def _choose(self, ready: dict[Lane, float], now: float, *, poll_grace_s: float) -> Lane:
        """Rules 1 and 2."""
        if len(ready) == 1:
            (first,) = ready
            self._passed[first] = 0
            return first
        first = min(ready)
        aged = [lane for lane, at in ready.items() if at <= now and self._passed[lane] > 0]
        chosen = max(aged, key=lambda lane: (self._passed[lane], -lane)) if aged else first
        if first is Lane.SLAVE_CONTROL and self._passed[chosen] < SLAVE_TURNS:
            chosen = first
        for lane, at in ready.items():
            grace_s = poll_grace_s if lane is Lane.POLL and chosen < Lane.CLIENT else 0.0
            if lane > chosen and at + grace_s <= now:
                self._passed[lane] += 1
        self._passed[chosen] = 0
        return chosen

    def _join(self, head: ClientRead) -> ReadTurn:
        queue = self._queue(head.lane)
        polls = self._polls[head.device.unit_id]
        others = queue.of_device(head.device)
        span = head.span
        reads: tuple[ClientRead, ...] = (head,)
        if len(others) > 1:
            span, reads = join(head, others, cost=self._cost, mapped=head.device.map.covers, most=polls.most_in)
        for read in reads:
            queue.take(read)
        pdu = head.pdu
        if span is not None and span != head.span:
            pdu = ReadRequest(span.function, span.first, span.count).encode()
        return ReadTurn(head.device, head.lane, pdu, span, reads)

    def _queue(self, lane: Lane) -> FairQueue:
        return self._background if lane is Lane.BACKGROUND else self._clients

    def _write_head(self, lane: Lane) -> WriteTurn | None:
        queue = self._writes[lane]
        while queue and queue[0].waiter.left:
            queue.popleft()
        return next((w for w in queue if not w.waiter.left and self._under_way.idle(w.device)), None)

    def _ready(self, device: Device) -> bool:
        """Whether a read of the device may begin (rule 7)."""
        if self._under_way.idle(device):
            return True
        if not self._under_way.open(device):
            return False
        writes = [write for queue in self._writes.values() if queue for write in queue]
        return not writes or not any(write.device is device and not write.waiter.left for write in writes)

    def _read_s(self, read: ClientRead) -> float:
        return self._cost(Space.REGISTERS, 3) if read.span is None else self._cost(read.span.space, read.span.count)

    def _fits(self, background: ClientRead, now: float) -> bool:
        due = self._next_poll_due(now)
        return due is None or now + self._read_s(background) <= due

    def _gather_at(self, background: ClientRead) -> float:
        return max(background.queued_at, self._served_at[Lane.BACKGROUND]) + GATHER_S

    def _early(self, background: ClientRead, now: float) -> PollItem | None:
        """The poll to bring forward for a background read that does not fit (rule 5)."""
        if now < self._gather_at(background):
            return None
        lists = [
            polls for polls in self._polls.values() if polls.breaker.probe_at is None and self._ready(polls.device)
        ]
        firsts = [polls.first() for polls in lists]
        in_the_way = [
            (due, item)
            for due, item in (first for first in firsts if first is not None)
            if due < now + self._read_s(background) and item.period_s is not None and item.early_at + GATHER_S <= now
        ]
        return min(in_the_way, key=itemgetter(0))[1] if in_the_way else None

    def _soonest_poll(self) -> float:
        """When the next poll of any device is due, whether or not it could begin then (rule 8)."""
        if self._no_poll_before == -math.inf:
            found = (polls.first() for polls in self._polls.values())
            self._no_poll_before = min((first[0] for first in found if first is not None), default=math.inf)
        return self._no_poll_before

    def _next_poll_due(self, now: float) -> float | None:
        soonest = self._soonest_poll()
        if now < soonest:
            return None if soonest == math.inf else soonest
        firsts = (polls.first() for polls in self._polls.values() if self._ready(polls.device))
        return min((first[0] for first in firsts if first is not None), default=None)

    def _due_poll(self, now: float) -> tuple[float, PollItem] | None:
        if now < self._soonest_poll():
            return None
        best: tuple[float, PollItem] | None = None
        for polls in self._polls.values():
            first = polls.first() if self._ready(polls.device) else None
            if first is not None and first[0] <= now and (best is None or first[0] < best[0]):
                best = first
        return best
