"""How many requests a Modbus TCP server may be given at once, as learnt from what it makes of them.

Rule 1: it begins with one. Each time that as many replies as the window is wide, and at least four, came on one
        connection, the window doubles, up to what is configured.
Rule 2: a sign that the server does not stand it makes it one again: a connection that the other end closed, or that
        was out of step, with several under way; a request that was answered only once it was alone.
Rule 3: after a sign the window stays at one for 10 s, after each further one for twice as long, up to ten minutes. An
        hour without a sign forgets the earlier ones.
"""

from __future__ import annotations

import math

FIRST_HOLD_S = 10.0
LAST_HOLD_S = 600.0
FORGET_S = 3600.0
LEAST_RUN = 4


class Window:
    """The window of one server; `most` is what is configured, 1 for no pipelining."""

    __slots__ = ("_held_until", "_hold_s", "_most", "_run", "_trouble_at", "size")

    def __init__(self, most: int) -> None:
        self.size = 1
        self._most = most
        self._run = 0
        self._trouble_at = -math.inf
        self._held_until = -math.inf
        self._hold_s = FIRST_HOLD_S

    def connected(self) -> None:
        """A new connection: what is counted is counted on one."""
        self._run = 0

    def answered(self, now: float) -> None:
        """A reply came (rule 1)."""
        self._run += 1
        if self._run >= max(LEAST_RUN, self.size) and now >= self._held_until:
            self.size = min(self._most, 2 * self.size)
            self._run = 0

    def trouble(self, now: float) -> None:
        """A sign of rule 2."""
        self._hold_s = FIRST_HOLD_S if now - self._trouble_at >= FORGET_S else min(2 * self._hold_s, LAST_HOLD_S)
        self.size = 1
        self._run = 0
        self._trouble_at = now
        self._held_until = now + self._hold_s
