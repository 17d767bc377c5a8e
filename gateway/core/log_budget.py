"""How often the log hears of something that a peer can cause as often as it likes.

Rule 1: the first of its kind is worth a line; the same again within the window is not.
Rule 2: no more than `lines` kinds are told in a window, however many there are; that also bounds the memory.
Rule 3: what was left out is counted, and the number goes with the next line that is told.
"""

from __future__ import annotations

from collections.abc import Hashable


class LogBudget:
    """Decides for one kind of event; windows begin with the first event after the last one ended."""

    def __init__(self, *, window_s: float = 60.0, lines: int = 100) -> None:
        self._window_s = window_s
        self._lines = lines
        self._ends = float("-inf")
        self._told: set[Hashable] = set()
        self._left_out = 0

    def spend(self, key: Hashable, now: float) -> int | None:
        """None: say nothing. Else say it, and say that so many lines were left out since the last one."""
        if now >= self._ends:
            self._ends = now + self._window_s
            self._told.clear()
        if key in self._told or len(self._told) >= self._lines:
            self._left_out += 1
            return None
        self._told.add(key)
        left_out, self._left_out = self._left_out, 0
        return left_out
