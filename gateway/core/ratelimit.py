"""How often a client may ask: token buckets.

Rule 1: a bucket holds at most `burst` tokens and gains `per_s` a second; it begins full. A request takes one; a
        request that finds none is refused with 06 and takes none, so that refusals do not add up to a ban.
Rule 2: each client has one bucket for all its requests and one for those that need a line. So has each device and each
        line, for what all clients together want of it. A request goes to the line only when all of them have a token.
Rule 3: only a client's own buckets say that this client shall wait: it is not read from until the empty one has
        a tenth of its burst again, at least `PAUSE_LEAST_S`, at most `PAUSE_MOST_S`.
Rule 4: a rate of 0 is no limit.

Times are monotonic seconds.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

from gateway.core.site import Device

CLIENT = "client"
CLIENT_LINE = "client_line"
"""Whose limit was met, as it is counted; the others are "device" and "line"."""

PAUSE_LEAST_S = 0.05
PAUSE_MOST_S = 1.0


@dataclass(frozen=True, slots=True)
class ClientRate:
    """What one client may ask; requests a second, 0 for no limit."""

    requests_per_s: float = 5000.0
    line_per_s: float = 50.0  # of these, those that need a line


@dataclass(frozen=True, slots=True)
class LineRates:
    """What all clients together may ask of the lines; requests a second, 0 for no limit."""

    device_per_s: float = 100.0
    line_per_s: float = 200.0


class Bucket:
    """Tokens of one kind; see rule 1."""

    __slots__ = ("_at", "_burst", "_per_s", "_tokens")

    def __init__(self, per_s: float, burst_s: float, now: float) -> None:
        self._per_s = per_s
        self._burst = max(1.0, per_s * burst_s)
        self._tokens = self._burst
        self._at = now

    def take(self, now: float, most: int = 1) -> int:
        """Take as many whole tokens as there are, at most `most`; returns how many."""
        if not self._per_s:
            return most
        self._fill(now)
        taken = min(most, int(self._tokens))
        self._tokens -= taken
        return taken

    def give_back(self, count: int) -> None:
        """Put back tokens that were taken and not used."""
        self._tokens = min(self._burst, self._tokens + count)

    def pause_s(self, now: float) -> float:
        """How long who found it empty shall wait (rule 3)."""
        self._fill(now)
        missing = max(1.0, self._burst / 10) - self._tokens
        return min(PAUSE_MOST_S, max(PAUSE_LEAST_S, missing / self._per_s if self._per_s else 0.0))

    def _fill(self, now: float) -> None:
        if now > self._at:
            self._tokens = min(self._burst, self._tokens + (now - self._at) * self._per_s)
            self._at = now


class LineLimiter:
    """The buckets of devices and lines (rule 2)."""

    def __init__(self, rates: LineRates, burst_s: float, devices: Iterable[Device]) -> None:
        lines: dict[str, Bucket] = {}
        self._buckets: dict[int, tuple[Bucket, Bucket]] = {}  # unit id → device's, line's
        for device in devices:
            line = lines.setdefault(device.line.name, Bucket(rates.line_per_s, burst_s, -math.inf))
            self._buckets[device.unit_id] = (Bucket(rates.device_per_s, burst_s, -math.inf), line)

    def take(self, client: Bucket, device: Device, now: float) -> str | None:
        """Take a token of the client, the device and the line, or none; returns whose limit is in the way."""
        own, line = self._buckets[device.unit_id]
        if not client.take(now):
            return CLIENT_LINE
        if not own.take(now):
            client.give_back(1)
            return "device"
        if not line.take(now):
            client.give_back(1)
            own.give_back(1)
            return "line"
        return None
