"""One run of the gateway, as the history knows it: which dates it made, and by which clock.

A run may have several keepers one after another (a reload, a model that was found): what one of them dated by a wrong
clock, the next one moves along when the clock is set.
"""

from __future__ import annotations

import asyncio
import secrets
from dataclasses import dataclass, field

from gateway.clock import Clock


def ahead_s(clock: Clock) -> float:
    """How far the wall clock is ahead of the time that never steps: another figure means that it was set."""
    return clock.wall() - clock.monotonic()


@dataclass(slots=True)
class Session:
    """What keepers hand on: `clock_offset` is what `ahead_s` was when dates were last right."""

    clock_offset: float
    controllers: set[int] = field(default_factory=set)  # the keys of those that it looked at
    number: int = field(default_factory=lambda: secrets.randbits(62))  # that no other run has
    minding: asyncio.Lock = field(default_factory=asyncio.Lock)  # held by who moves dates

    @classmethod
    def begin(cls, clock: Clock) -> Session:
        """The run that begins now."""
        return cls(ahead_s(clock))
