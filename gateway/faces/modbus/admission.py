"""Who gets in, and who makes room for it.

Rule 1: a client that is not in `allow` is refused.
Rule 2: there are at most `max_connections`, and at most `max_per_client` of one client. Over that the connection (of
        this client, where it is this client's limit) that asked nothing for longest makes room, if that was for
        `evict_idle_s` and it waits for nothing; else the newcomer is refused.
Rule 3: a client in `priority` always gets in: its own connections make room also when they are at work a moment ago,
        and so does any connection without priority, the idle ones first. One with priority makes room for none but its
        own client.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

from gateway.core.ratelimit import ClientRate
from gateway.faces.modbus.settings import ModbusSettings, RateSettings
from gateway.faces.modbus.tcp import allowed


class Seat(Protocol):
    """A connection as admission sees it."""

    @property
    def peer(self) -> str:
        """The client's address."""
        ...

    @property
    def idle(self) -> bool:
        """Whether the client waits for nothing."""
        ...

    @property
    def seen(self) -> float:
        """Monotonic time of its last request."""
        ...


S = TypeVar("S", bound=Seat)


@dataclass(frozen=True, slots=True)
class Verdict(Generic[S]):
    """Why the newcomer is refused (None: it gets in), and who leaves for it."""

    refused: str | None = None
    leaves: S | None = None


def decide(seats: Collection[S], peer: str, settings: ModbusSettings, now: float) -> Verdict[S]:
    """Whether a newcomer from `peer` gets in."""
    if not allowed(peer, settings.allow):
        return Verdict("not_allowed")
    important = allowed(peer, settings.priority)
    own = [seat for seat in seats if seat.peer == peer]
    if len(own) >= settings.max_per_client:
        candidates, reason = own, "client_full"
    elif len(seats) >= settings.max_connections:
        candidates, reason = [seat for seat in seats if not allowed(seat.peer, settings.priority)], "full"
        if important:
            candidates = candidates or own
    else:
        return Verdict()
    leaves = _longest_idle(candidates, at_work_too=important)
    if leaves is None or (not important and now - leaves.seen < settings.evict_idle_s):
        return Verdict(reason)
    return Verdict(leaves=leaves)


def rate_of(peer: str, rates: RateSettings) -> ClientRate:
    """How often a client may ask: the first network that holds it decides."""
    return next((rate for networks, rate in rates.networks if allowed(peer, networks)), rates.client)


def _longest_idle(seats: Iterable[S], *, at_work_too: bool) -> S | None:
    candidates = [seat for seat in seats if at_work_too or seat.idle]
    return min(candidates, key=lambda seat: (not seat.idle, seat.seen), default=None)
