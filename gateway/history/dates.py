"""When was a day written? The log has no dates, only the hourmeter at which each of its days ended.

Rule 1: a date is an estimate with an error bound, and both are stored and shown.
Rule 2: the hourmeter counts whole hours in the day and at the look, so an age by it is right to an hour either way.
        To this come the gateway's clock and the drift of the controller's.
Rule 3: the hourmeter stands still while the controller has no power. A day written between two looks lies between
        the earliest that the first allows (counting forward) and the latest that the second allows (counting back);
        the middle is taken. For days older than the first look nothing tells of such pauses: their bound holds for
        a controller that always had power, else they are older than stated.
Rule 4: two looks that are further apart by hourmeter than by the clock mean that the gateway's clock was wrong at
        one of them: the difference is added to the bound.
Rule 5: a day ahead of the hourmeter was written before the controller lost its power, and some hours with it: not after
        the look, and when is not known to a day.
Rule 6: a clock that shows a year before this program existed was never set: no date is better than that one.
"""

from __future__ import annotations

from dataclasses import dataclass

from gateway.devices.log import LOST_HOURS

HOUR_S = 3600.0
CLOCK_S = 60.0
"""What the gateway's clock is believed to."""
DRIFT = 0.001
"""What the controller's clock is believed to, as a share of the time passed; the documents give no figure."""
FIRST_PLAUSIBLE_WALL = 1_767_225_600.0
"""2026-01-01 UTC."""


@dataclass(frozen=True, slots=True)
class Look:
    """One look at a controller: its hourmeter and the gateway's clock (Unix time) at the same moment."""

    hours: int
    wall: float

    @property
    def clock_set(self) -> bool:
        """Whether the clock can have been right."""
        return self.wall >= FIRST_PLAUSIBLE_WALL


@dataclass(frozen=True, slots=True)
class Estimate:
    """When a day was written: Unix time, and by how much it may be wrong either way."""

    at: float
    error_s: float


def estimate(hourmeter: int, now: Look, before: Look | None = None) -> Estimate | None:
    """When the day with this hourmeter was written, by the look of now and the last one before it; None: rule 6."""
    if not now.clock_set:
        return None
    latest = now.wall - max(0, now.hours - hourmeter) * HOUR_S
    after_s = _error_s(now.hours - hourmeter)
    if before is None or not before.clock_set or hourmeter < before.hours:
        return Estimate(latest, after_s + (LOST_HOURS * HOUR_S if hourmeter > now.hours + 1 else 0.0))
    earliest = before.wall + (hourmeter - before.hours) * HOUR_S
    if latest < earliest - after_s:
        return Estimate(latest, after_s + earliest - latest)
    first, last = earliest - _error_s(hourmeter - before.hours), latest + after_s
    return Estimate((first + last) / 2, (last - first) / 2)


def _error_s(hours: int) -> float:
    """What an age by the hourmeter is right to, pauses aside."""
    return HOUR_S + CLOCK_S + DRIFT * abs(hours) * HOUR_S
