"""What one receiver is told of the conditions, and when.

Rule 1: a receiver is told that a condition is raised, then that it is clear, in turns: never the same twice, and never
        that something is clear of which it was not told.
Rule 2: after it was told of a condition, it is told of that one again `hold_s` later at the earliest; what holds then
        is what it is told. A condition that was raised and is clear again by then is told as raised, and then as clear.
Rule 3: what waits is one entry a condition, so however long a receiver is away and whatever flaps meanwhile, it is
        bounded; and what the receiver gets when it is back is the present state.
Rule 4: nothing is told of a condition while the receiver has not confirmed what it was told of it (`busy`).
Rule 5: what was raised when the gateway first looked is told as a summary, not as an event.
Rule 6: a receiver knows a condition by its unit id and code. When a reload puts another one in its place, rule 1 holds
        for the two together: what was told as raised is told as clear once the other one is. Of a place that is gone
        nothing more is told.

Times are monotonic.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

from gateway.core.conditions import Conditions, ConditionState, Severity, Watch


@dataclass(frozen=True, slots=True)
class Announcement:
    """Tell this."""

    watch: Watch
    raised: bool
    summary: bool  # it was so before; nothing happened now


Place = tuple[int, int]
"""Unit id and code."""


@dataclass(slots=True)
class _Told:
    """What the receiver knows of a condition."""

    watch: Watch
    raised: bool = False
    times: int = 0  # `Watch.times` when it was told
    at: float = -math.inf
    busy: bool = False


class Announcer:
    """Decides for one receiver; `least` is the severity below which it is told nothing."""

    def __init__(self, *, hold_s: float, least: Severity = Severity.INFO) -> None:
        self._hold_s = hold_s
        self._least = least
        self._told: dict[Place, _Told] = {}
        self._waiting: dict[Place, float] = {}  # when to tell

    def __len__(self) -> int:
        """How many conditions there may be something to tell of."""
        return len(self._waiting)

    def changed(self, watches: Iterable[Watch], now: float) -> None:
        """The state of these may have changed."""
        for watch in watches:
            if watch.condition.severity >= self._least:
                place = _place(watch)
                told = self._told.get(place)
                if told is None and watch.times:
                    told = self._told[place] = _Told(watch)
                if told is not None:
                    self._waiting.setdefault(place, max(now, told.at + self._hold_s))

    def adjust(self, *, hold_s: float, least: Severity) -> None:
        """Go on by these; what was told stays told."""
        self._hold_s = hold_s
        self._least = least

    def go_on(self, conditions: Conditions) -> None:
        """There are these conditions from now on (rule 6); what changes with them follows by `changed`."""
        before, self._told = self._told, {}
        for place, told in before.items():
            watch = conditions.at(*place)
            if watch is None:
                self._waiting.pop(place, None)
                continue
            if watch is not told.watch:
                self._waiting.pop(place, None)
                told.watch, told.times = watch, 0
            self._told[place] = told

    def next_due(self) -> float | None:
        """When there may be something to tell; None: not before something changes."""
        return min((due for place, due in self._waiting.items() if not self._told[place].busy), default=None)

    def take(self, now: float, room: int) -> list[Announcement]:
        """At most `room` announcements that are due; each counts as told and, until `confirmed`, as busy."""
        ready = [place for place, due in self._waiting.items() if due <= now and not self._told[place].busy]
        found: list[Announcement] = []
        for place in ready:
            if len(found) >= room:
                break
            del self._waiting[place]
            announcement = self._announce(self._told[place], now)
            if announcement is not None:
                found.append(announcement)
        return found

    def confirmed(self, watch: Watch) -> None:
        """The receiver knows what it was told, or nobody will ever know."""
        place = _place(watch)
        told = self._told.get(place)
        if told is None:
            return
        told.busy = False
        if self._news(told) is not None:
            self._waiting.setdefault(place, told.at + self._hold_s)

    def lost(self, announcement: Announcement) -> None:
        """The receiver was not told after all: it is told again as soon as `take` is called."""
        place = _place(announcement.watch)
        told = self._told.get(place)
        if told is None:
            return
        told.busy = False
        told.raised = not announcement.raised
        told.times = max(0, told.times - announcement.raised)
        told.at = -math.inf
        self._waiting[place] = -math.inf

    def _announce(self, told: _Told, now: float) -> Announcement | None:
        raised = self._news(told)
        if raised is None:
            return None
        watch = told.watch
        told.raised, told.times, told.at, told.busy = raised, watch.times, now, True
        return Announcement(watch, raised, summary=raised and watch.from_start)

    @staticmethod
    def _news(told: _Told) -> bool | None:
        """What is to be told next: that it is raised (True), that it is clear (False), or nothing."""
        watch = told.watch
        if told.raised:
            return False if watch.known is ConditionState.CLEAR else None
        return True if watch.times > told.times else None


def _place(watch: Watch) -> Place:
    return watch.unit_id, watch.condition.code
