"""How busy a line is, as the share of the last minute."""

from __future__ import annotations

WINDOW_S = 60


class UseMeter:
    """Sums busy time in one-second slots; constant memory, constant cost."""

    def __init__(self, now: float) -> None:
        self._since = now
        self._slots = [0.0] * WINDOW_S
        self._second = int(now)

    def add(self, start: float, end: float) -> None:
        """The line was occupied from `start` to `end` (monotonic seconds, `end` not in the future)."""
        self._advance(end)
        second = max(int(start), self._second - WINDOW_S + 1)
        while second <= self._second:
            share = min(end, second + 1.0) - max(start, float(second))
            if share > 0:
                self._slots[second % WINDOW_S] += share
            second += 1

    def ratio(self, now: float) -> float:
        """Busy share, 0 to 1, of the last minute or of the time since start where that is shorter."""
        self._advance(now)
        span = min(now - self._since, (WINDOW_S - 1) + now - self._second)
        return min(1.0, sum(self._slots) / span) if span > 0 else 0.0

    def _advance(self, now: float) -> None:
        second = int(now)
        steps = min(second - self._second, WINDOW_S)
        for step in range(steps):
            self._slots[(second - step) % WINDOW_S] = 0.0
        self._second = max(second, self._second)
