"""The client lane: a fair share of the line for each client.

Rule 1: clients take turns by the line time they have used: the one that used least goes first, so one who asks
        for everything slows only itself. Line time of a joined read is shared by those who waited for it.
Rule 2: a client that was idle starts level with the least of those that are waiting: idleness is not saved up.
Rule 3: a read that several clients wait for goes as soon as the first of them has its turn.
Rule 4: at most `limit` reads wait. When one more comes, the client with the most waiting reads loses its newest;
        the newcomer is refused when that is the newcomer itself.
Rule 5: an asker that waited `limit_s` is given up.

A client is named by whoever asks (the TCP face: by its address); at most `MAX_CLIENTS` are remembered.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

from gateway.core.requests import ClientRead, Lane, Span, Waiter
from gateway.core.site import Device
from gateway.errors import QueueFull

MAX_CLIENTS = 256
_NONE: dict[bytes, ClientRead] = {}


@dataclass(slots=True, eq=False)
class _Share:
    """One client's used line time and its waiting reads, oldest first."""

    used_s: float
    reads: deque[ClientRead] = field(default_factory=deque)


class FairQueue:
    """Reads that clients wait for."""

    def __init__(self, lane: Lane, *, limit: int, limit_s: float) -> None:
        self._lane = lane
        self._limit = limit
        self._limit_s = limit_s
        self._shares: dict[str, _Share] = {}
        self._waiting: dict[tuple[int, bytes], ClientRead] = {}
        self._of_unit: dict[int, dict[bytes, ClientRead]] = {}  # the same by device; none that is empty
        self._arrivals: deque[tuple[float, Waiter, ClientRead]] = deque()
        self._level_s = 0.0  # used time of the client that went last

    def __len__(self) -> int:
        return len(self._waiting)

    def adjust(self, *, limit: int, limit_s: float) -> None:
        """Other limits from now on; who waits already is not turned away by the new `limit`."""
        self._limit = limit
        self._limit_s = limit_s

    def add(self, device: Device, pdu: bytes, span: Span | None, waiter: Waiter) -> ClientRead | None:
        """Queue a read or join an identical one; raises QueueFull (rule 4).

        Returns the read that had to give way, which the caller ends with QueueFull, or None.
        """
        key = (device.unit_id, pdu)
        loser: ClientRead | None = None
        read = self._waiting.get(key)
        if read is None:
            if len(self._waiting) >= self._limit:
                self._drop_unwanted()
            if len(self._waiting) >= self._limit:
                loser = self._give_way(waiter.client)
            read = ClientRead(device, pdu, self._lane, span, waiter.asked_at)
            self._keep(key, read)
        read.waiters.append(waiter)
        self._arrivals.append((waiter.asked_at + self._limit_s, waiter, read))
        self._enqueue(waiter.client, read)
        return loser

    def retry(self, read: ClientRead) -> None:
        """Put a read that failed back, ahead of its clients' other reads."""
        key = (read.device.unit_id, read.pdu)
        read.started = False
        newer = self._waiting.get(key)
        if newer is not None:
            read.waiters += newer.waiters
            newer.waiters = []
            newer.started = True
        self._keep(key, read)
        for client in read.clients():
            self._enqueue(client, read, first=True)

    def head(self, ready: Callable[[Device], bool] = lambda _device: True) -> ClientRead | None:
        """The read whose turn it is (rules 1 and 3) among those whose device is `ready`, or None."""
        best: tuple[float, float, str] | None = None
        best_read: ClientRead | None = None
        known: dict[int, bool] = {}  # unit id → whether its device is ready
        idle: list[str] = []
        for client, share in self._shares.items():
            if not share.reads or share.reads[0].started or not share.reads[0].wanted:
                self._prune(share)
            if not share.reads:
                if share.used_s <= self._level_s or len(self._shares) - len(idle) > MAX_CLIENTS:
                    idle.append(client)
                continue
            read = share.reads[0]
            unit = read.device.unit_id
            if unit not in known:
                known[unit] = ready(read.device)
            found = read if known[unit] else _first_ready(share, ready)
            if found is not None and (best is None or (share.used_s, found.queued_at, client) < best):
                best, best_read = (share.used_s, found.queued_at, client), found
        for client in idle:
            del self._shares[client]
        if best is not None:
            self._level_s = max(self._level_s, best[0])
        return best_read

    def of_device(self, device: Device) -> list[ClientRead]:
        """All wanted reads that wait for one device, oldest first."""
        return [read for read in self._of_unit.get(device.unit_id, _NONE).values() if read.wanted]

    def take(self, read: ClientRead) -> None:
        """The read is being made; it takes no new waiters."""
        read.started = True
        key = (read.device.unit_id, read.pdu)
        if self._waiting.get(key) is read:
            del self._waiting[key]
            reads = self._of_unit[key[0]]
            del reads[key[1]]
            if not reads:
                del self._of_unit[key[0]]

    def charge(self, clients: list[str], seconds: float) -> None:
        """Book line time on those who waited for it (rule 1)."""
        for client in clients:
            share = self._shares.get(client)
            if share is not None:
                share.used_s += seconds / len(clients)

    def next_expiry(self) -> float | None:
        """When the oldest asker will have waited too long."""
        while self._arrivals and (self._arrivals[0][1].left or self._arrivals[0][2].started):
            self._arrivals.popleft()
        return self._arrivals[0][0] if self._arrivals else None

    def expired(self, now: float) -> list[Waiter]:
        """Take out the askers that waited too long (rule 5)."""
        out: list[Waiter] = []
        while (at := self.next_expiry()) is not None and at <= now:
            _, waiter, read = self._arrivals.popleft()
            out.append(waiter)
            read.waiters.remove(waiter)
            if not read.wanted:
                self.take(read)
        return out

    def drain(self, device: Device | None = None) -> list[ClientRead]:
        """Take out all reads, or those of one device."""
        out = [read for read in self._waiting.values() if device is None or read.device is device]
        for read in out:
            self.take(read)
        return out

    def _keep(self, key: tuple[int, bytes], read: ClientRead) -> None:
        self._waiting[key] = read
        self._of_unit.setdefault(key[0], {})[key[1]] = read

    def _enqueue(self, client: str, read: ClientRead, *, first: bool = False) -> None:
        share = self._shares.get(client)
        if share is None:
            share = self._shares[client] = _Share(self._level_s)
        elif not share.reads:
            share.used_s = max(share.used_s, self._level_s)
        if read in share.reads:
            return
        if first:
            share.reads.appendleft(read)
        else:
            share.reads.append(read)

    def _prune(self, share: _Share) -> None:
        while share.reads and (share.reads[0].started or not share.reads[0].wanted):
            read = share.reads.popleft()
            if not read.started:
                self.take(read)

    def _drop_unwanted(self) -> None:
        for read in [read for read in self._waiting.values() if not read.wanted]:
            self.take(read)

    def _give_way(self, newcomer: str) -> ClientRead:
        """Rule 4: the newest read that only the greediest client waits for."""
        counts: dict[str, int] = {newcomer: 1}
        for read in self._waiting.values():
            for client in read.clients():
                counts[client] = counts.get(client, 0) + 1
        greediest = max(counts, key=lambda client: (counts[client], client == newcomer))
        if greediest != newcomer:
            for read in reversed(self._waiting.values()):
                if read.clients() == [greediest]:
                    self.take(read)
                    return read
        raise QueueFull


def _first_ready(share: _Share, ready: Callable[[Device], bool]) -> ClientRead | None:
    return next((read for read in share.reads if not read.started and read.wanted and ready(read.device)), None)
