"""When is a controller's log read? Seldom, and soon after it has something new.

Rule 1: at once after the start, and when another controller seems to be there: the hourmeter went back, or product
        or serial number are others than at the last harvest.
Rule 2: then when the hourmeter says that a day must have ended: `DAY_HOURS` after the newest one, and one hour more,
        because dusk moves. While it has not come, again every `AGAIN_S`.
Rule 3: at the latest `interval_s` after the last one; so a gap of any length is closed within it, and one of more
        than a day at once.
Rule 4: after a failure again in a minute, twice as long each time, at most an hour.
"""

from __future__ import annotations

from dataclasses import dataclass

DAY_HOURS = 24
AGAIN_S = 3600.0
FIRST_RETRY_S = 60.0
LAST_RETRY_S = 3600.0

Who = tuple[str, str]
"""Product and serial number."""


@dataclass(slots=True)
class Schedule:
    """The schedule of one device; times are monotonic seconds."""

    interval_s: float
    _who: Who | None = None
    _hours: int = 0
    _newest: int | None = None
    _done_at: float | None = None
    _retry_at: float | None = None
    _retry_s: float = FIRST_RETRY_S

    def due(self, now: float, hours: int, who: Who) -> bool:
        """Whether to harvest now, while the live hourmeter shows `hours`."""
        if self._retry_at is not None:
            return now >= self._retry_at
        if self._done_at is None or hours < self._hours or who != self._who:
            return True
        since_s = now - self._done_at
        if since_s >= self.interval_s:
            return True
        return self._newest is not None and hours > self._newest + DAY_HOURS and since_s >= AGAIN_S

    def done(self, now: float, hours: int, who: Who, newest: int | None) -> None:
        """A harvest was finished; `newest` is the hourmeter of the newest day."""
        self._done_at, self._hours, self._who, self._newest = now, hours, who, newest
        self._retry_at, self._retry_s = None, FIRST_RETRY_S

    def failed(self, now: float) -> None:
        """A harvest was not finished."""
        self._retry_at = now + self._retry_s
        self._retry_s = min(2 * self._retry_s, LAST_RETRY_S)

    def interrupted(self, now: float) -> None:
        """The device or its line went away; what is due stays due once it is back."""
        self._retry_at = now
