"""Time as an object, so that tests own it.

Durations and ages come from `monotonic()`; `wall()` is only for showing dates to people.

A machine may sleep. What was read before is as old as it is, and a controller went on counting its hours meanwhile, so
`monotonic()` goes on too. Timers of the event loop do not: who waits for long looks at the clock now and then.
"""

from __future__ import annotations

import time
from functools import partial
from typing import Protocol

_AWAKE_OR_ASLEEP = getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC)


class Clock(Protocol):
    """What the shells (lines, faces, service) read the time from; `modbus/` and `core/` get numbers."""

    def monotonic(self) -> float:
        """Seconds from an arbitrary start, the machine's sleep included where the system can tell; never steps back."""
        ...

    def wall(self) -> float:
        """Seconds since 1970-01-01 UTC; may step."""
        ...


class SystemClock:
    """The machine's clocks."""

    # The functions themselves, without a frame of ours around them: every Modbus request asks the time.
    monotonic = staticmethod(partial(time.clock_gettime, _AWAKE_OR_ASLEEP))
    wall = staticmethod(time.time)
