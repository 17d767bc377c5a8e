"""Repeats in the log: the first occurrence at once, then one line with a count per interval."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(slots=True)
class _Repeats:
    since: float
    count: int


class Throttle:
    """Decides when an event is logged again. Keys are reasons, never anything a peer can choose."""

    def __init__(self, interval_s: float = 60.0) -> None:
        self._interval_s = interval_s
        self._known: dict[str, _Repeats] = {}

    def due(self, key: str, now: float) -> int | None:
        """How often `key` happened since it was last logged when it is to be logged now, else None."""
        known = self._known.get(key)
        if known is None:
            self._known[key] = _Repeats(now, 0)
            return 1
        known.count += 1
        if now - known.since < self._interval_s:
            return None
        count, known.count, known.since = known.count, 0, now
        return count
