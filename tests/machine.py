"""What a busy machine does to a measured time, so that a test can leave it out."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Self

SCHEDULE = Path("/proc/thread-self/schedstat")
TICK_S = 0.02


def kept_waiting_s() -> float:
    """Seconds in which this thread could have run and others had the processor; 0 where nobody counts them."""
    with contextlib.suppress(OSError):
        return int(SCHEDULE.read_text().split()[1]) / 1e9
    return 0.0


class Stopwatch:
    """Time since it was made, or started again, but for that in which this thread waited for a processor."""

    def __init__(self) -> None:
        self.start()

    def start(self) -> None:
        """Begin anew."""
        self._began, self._waited_s = time.monotonic(), kept_waiting_s()

    @property
    def s(self) -> float:
        """Seconds."""
        return time.monotonic() - self._began - (kept_waiting_s() - self._waited_s)


class Bystander:
    """Time since its start, but for that in which the whole machine stood still.

    For what other processes take: who looks on wants a moment of every 20 ms, and nobody is blamed for more than two
    of these in which he got none.
    """

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        self._now = now
        self._over = threading.Event()
        self._looking = threading.Thread(target=self._look, daemon=True)
        self.s = 0.0
        """Seconds until the last look."""

    def start(self) -> None:
        """Begin to count."""
        self.before = self._now()
        self._looking.start()

    def stop(self) -> float:
        """Count no more; seconds."""
        self._over.set()
        if self._looking.is_alive():
            self._looking.join()
        return self.s

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.stop()

    def _look(self) -> None:
        while not self._over.wait(TICK_S):
            self.look()
        self.look()

    def look(self) -> None:
        """Take the time; done by itself every 20 ms."""
        now = self._now()
        self.s += min(now - self.before, 2 * TICK_S)
        self.before = now
