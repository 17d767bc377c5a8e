"""Who asks: the clients of a face by their addresses, what each did, and how much it still may.

Rule 1: clients with a connection are all known; of the others the last `REMEMBERED`, so that nobody gets a new
        bucket by connecting again, and so that an operator sees who was here.
Rule 2: a request costs one token of its client. Tokens are taken from the bucket by the `LEASE`, so that a request
        answered from memory costs one subtraction (`left`), which is also its count: what was granted and is not
        left was asked. `settle` brings these counts into the face's.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator

from gateway.core.ratelimit import Bucket, ClientRate
from gateway.core.stats import ModbusServerStats

REMEMBERED = 256
LEASE = 256
_UNLIMITED = 1 << 40


class Client:
    """One client address. `left` requests may be answered before the bucket is asked again."""

    __slots__ = (
        "_granted",
        "_settled",
        "_size",
        "bucket",
        "connections",
        "exceptions",
        "first_seen",
        "forwarded",
        "last_seen",
        "left",
        "limited",
        "line_bucket",
        "name",
        "open_connections",
        "pause_s",
        "refused",
        "slow",
        "unpaid",
    )

    def __init__(self, name: str, rate: ClientRate, burst_s: float, now: float) -> None:
        self.name = name
        self.bucket = Bucket(rate.requests_per_s, burst_s, now)
        self.line_bucket = Bucket(rate.line_per_s, burst_s, now)
        self._size = LEASE if rate.requests_per_s else _UNLIMITED
        self._granted = 0
        self._settled = 0
        self.left = 0
        self.first_seen = self.last_seen = now
        self.connections = 0
        self.open_connections = 0
        self.slow = 0  # requests that paid with a token and were not found ready
        self.forwarded = 0  # requests that needed a line
        self.refused = 0  # requests answered with an exception of the gateway's own, without asking a line
        self.limited = 0  # of these, those over a rate, its own or a common one
        self.unpaid = 0  # of these, those for which it had no token
        self.exceptions: Counter[int] = Counter()  # all exceptions it was given, by code
        self.pause_s = 0.0  # how long nothing shall be read from it, for who asks next to take

    def limit(self, rate: ClientRate, burst_s: float, now: float) -> None:
        """Another rate from now on, with full buckets; what was leased and not used is given back."""
        self.bucket = Bucket(rate.requests_per_s, burst_s, now)
        self.line_bucket = Bucket(rate.line_per_s, burst_s, now)
        self._size = LEASE if rate.requests_per_s else _UNLIMITED
        self._granted -= self.left
        self.left = 0

    @property
    def requests(self) -> int:
        """What it asked."""
        return self._granted - self.left + self.unpaid

    @property
    def cache_hits(self) -> int:
        """What it had from memory."""
        return self.requests - self.forwarded - self.refused

    def lease(self, now: float) -> bool:
        """Have tokens, if there are any; False: over the rate."""
        if self.left:
            return True
        self.left = self.bucket.take(now, self._size)
        self._granted += self.left
        return self.left > 0

    def settle(self, stats: ModbusServerStats) -> None:
        """Count in `stats` what was found ready since the last time."""
        ready = self._granted - self.left - self.slow
        stats.requests += ready - self._settled
        stats.cache_hits += ready - self._settled
        self._settled = ready


class ClientTable:
    """All clients of a face."""

    def __init__(self, stats: ModbusServerStats, burst_s: float) -> None:
        self._stats = stats
        self._burst_s = burst_s
        self._clients: dict[str, Client] = {}  # the longest gone first

    def __iter__(self) -> Iterator[Client]:
        return iter(tuple(self._clients.values()))

    def __len__(self) -> int:
        return len(self._clients)

    def arrived(self, name: str, rate: ClientRate, now: float) -> Client:
        """A connection of this client was let in."""
        client = self._clients.get(name)
        if client is None:
            client = self._clients[name] = Client(name, rate, self._burst_s, now)
            self._forget()
        client.connections += 1
        client.open_connections += 1
        client.last_seen = now
        return client

    def limit(self, rate_of: Callable[[str], ClientRate], burst_s: float, now: float) -> None:
        """Other rates from now on, for those that are known too."""
        self._burst_s = burst_s
        for client in self._clients.values():
            client.limit(rate_of(client.name), burst_s, now)

    def left(self, client: Client, last_seen: float) -> None:
        """A connection of this client is over."""
        client.settle(self._stats)
        client.open_connections -= 1
        client.last_seen = max(client.last_seen, last_seen)
        self._clients[client.name] = self._clients.pop(client.name, client)

    def settle(self) -> None:
        """Bring the face's counters up to date."""
        for client in self._clients.values():
            client.settle(self._stats)

    def _forget(self) -> None:
        gone = [client for client in self._clients.values() if not client.open_connections]
        for client in gone[: max(0, len(gone) - REMEMBERED)]:
            del self._clients[client.name]
