"""What a busy machine does to a measured time, so that a test can leave it out."""

from __future__ import annotations

import contextlib
import time
from pathlib import Path

SCHEDULE = Path("/proc/thread-self/schedstat")


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
