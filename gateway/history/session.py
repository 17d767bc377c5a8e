"""One run of the gateway, as the history knows it: which dates it made, and by which clock.

A run may have several keepers one after another (a reload, a model that was found): what one of them dated by a wrong
clock, the next one moves along when the clock is set.
"""

from __future__ import annotations

import asyncio
import secrets
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from gateway.clock import Clock


def awake_s() -> float:
    """Seconds from an arbitrary start, the machine's sleep included where the system can tell."""
    boot = getattr(time, "CLOCK_BOOTTIME", None)
    return time.monotonic() if boot is None else time.clock_gettime(boot)


@dataclass(slots=True)
class Session:
    """What keepers hand on: `clock_offset` is how far the clock was ahead of `awake_s` when dates were last right."""

    clock_offset: float
    controllers: set[int] = field(default_factory=set)  # the keys of those that it looked at
    number: int = field(default_factory=lambda: secrets.randbits(62))  # that no other run has
    minding: asyncio.Lock = field(default_factory=asyncio.Lock)  # held by who moves dates

    @classmethod
    def begin(cls, clock: Clock, awake_s: Callable[[], float] = awake_s) -> Session:
        """The run that begins now."""
        return cls(clock.wall() - awake_s())
