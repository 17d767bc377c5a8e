"""Time as an object, so that tests own it.

Durations and ages come from `monotonic()`; `wall()` is only for showing dates to people.
"""

from __future__ import annotations

import time
from typing import Protocol


class Clock(Protocol):
    """What the shells (lines, faces, service) read the time from; `modbus/` and `core/` get numbers."""

    def monotonic(self) -> float:
        """Seconds from an arbitrary start; never steps."""
        ...

    def wall(self) -> float:
        """Seconds since 1970-01-01 UTC; may step."""
        ...


class SystemClock:
    """The machine's clocks."""

    # The functions themselves, without a frame of ours around them: every Modbus request asks the time.
    monotonic = staticmethod(time.monotonic)
    wall = staticmethod(time.time)
