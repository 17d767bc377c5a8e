"""What one receiver is told of the conditions, and when.

Rule 1: a receiver is told that a condition is raised, then that it is clear, in turns: never the same twice, and never
        that something is clear of which it was not told.
Rule 2: after it was told of a condition, it is told of that one again `hold_s` later at the earliest; what holds then
        is what it is told. A condition that was raised and is clear again by then is told as raised, and then as clear.
Rule 3: what waits is one entry a condition, so however long a receiver is away and whatever flaps meanwhile, it is
        bounded; and what the receiver gets when it is back is the present state.
Rule 4: nothing is told of a condition while the receiver has not confirmed what it was told of it (`busy`).
Rule 5: what was raised when the gateway first looked is told as a summary, not as an event.

Times are monotonic.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

from gateway.core.conditions import ConditionState, Severity, Watch


@dataclass(frozen=True, slots=True)
class Announcement:
    """Tell this."""

    watch: Watch
    raised: bool
    summary: bool  # it was so before; nothing happened now


@dataclass(slots=True)
class _Told:
    """What the receiver knows of a condition."""

    raised: bool = False
    times: int = 0  # `Watch.times` when it was told
    at: float = -math.inf
    busy: bool = False


class Announcer:
    """Decides for one receiver; `least` is the severity below which it is told nothing."""

    def __init__(self, *, hold_s: float, least: Severity = Severity.INFO) -> None:
        self._hold_s = hold_s
        self._least = least
        self._told: dict[Watch, _Told] = {}
        self._waiting: dict[Watch, float] = {}  # when to tell

    def __len__(self) -> int:
        """How many conditions there may be something to tell of."""
        return len(self._waiting)

    def changed(self, watches: Iterable[Watch], now: float) -> None:
        """The state of these may have changed."""
        for watch in watches:
            if watch.condition.severity >= self._least:
                told = self._told.get(watch)
                due = now if told is None else max(now, told.at + self._hold_s)
                if told is not None or watch.times:
                    self._waiting.setdefault(watch, due)

    def next_due(self) -> float | None:
        """When there may be something to tell; None: not before something changes."""
        return min((due for watch, due in self._waiting.items() if not self._is_busy(watch)), default=None)

    def take(self, now: float, room: int) -> list[Announcement]:
        """At most `room` announcements that are due; each counts as told and, until `confirmed`, as busy."""
        ready = [watch for watch, due in self._waiting.items() if due <= now and not self._is_busy(watch)]
        found: list[Announcement] = []
        for watch in ready:
            if len(found) >= room:
                break
            del self._waiting[watch]
            announcement = self._announce(watch, now)
            if announcement is not None:
                found.append(announcement)
        return found

    def confirmed(self, watch: Watch) -> None:
        """The receiver knows what it was told, or nobody will ever know."""
        told = self._told[watch]
        told.busy = False
        if self._news(watch, told) is not None:
            self._waiting.setdefault(watch, told.at + self._hold_s)

    def lost(self, announcement: Announcement) -> None:
        """The receiver was not told after all: it is told again as soon as `take` is called."""
        told = self._told[announcement.watch]
        told.busy = False
        told.raised = not announcement.raised
        told.times -= announcement.raised
        told.at = -math.inf
        self._waiting[announcement.watch] = -math.inf

    def _is_busy(self, watch: Watch) -> bool:
        told = self._told.get(watch)
        return told is not None and told.busy

    def _announce(self, watch: Watch, now: float) -> Announcement | None:
        told = self._told.setdefault(watch, _Told())
        raised = self._news(watch, told)
        if raised is None:
            return None
        told.raised, told.times, told.at, told.busy = raised, watch.times, now, True
        return Announcement(watch, raised, summary=raised and watch.from_start)

    @staticmethod
    def _news(watch: Watch, told: _Told) -> bool | None:
        """What is to be told next: that it is raised (True), that it is clear (False), or nothing."""
        if told.raised:
            return False if watch.known is ConditionState.CLEAR else None
        return True if watch.times > told.times else None
