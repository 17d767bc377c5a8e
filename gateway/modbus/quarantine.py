"""How long a line must be silent after a failure.

Rule 1: the window is what was configured, as long as it catches the late replies.
Rule 2: a straggler is a reply that outlived it. Two within 60 s double the window, up to 2 s.
Rule 3: each 60 s without a straggler halve it again, down to what was configured.
"""

from __future__ import annotations

import math

MAX_WINDOW_S = 2.0
MEMORY_S = 60.0


class QuarantineWindow:
    """The window in seconds, and what it learns; a configured window above 2 s stays as it is."""

    __slots__ = ("_base_s", "_changed_at", "_straggler_at", "_window_s")

    def __init__(self, base_s: float) -> None:
        self._base_s = self._window_s = base_s
        self._changed_at = -math.inf
        self._straggler_at = -math.inf

    def seconds(self, now: float) -> float:
        """The window at `now`."""
        while self._window_s > self._base_s and now - self._changed_at >= MEMORY_S:
            self._window_s = max(self._base_s, self._window_s / 2)
            self._changed_at += MEMORY_S
        return self._window_s

    def straggler(self, now: float) -> None:
        """A late reply was seen that the window did not catch."""
        window_s = self.seconds(now)
        if now - self._straggler_at < MEMORY_S:
            self._window_s = max(window_s, min(2 * window_s, MAX_WINDOW_S))
            self._straggler_at = -math.inf
        else:
            self._straggler_at = now
        self._changed_at = now
