"""What a process holds, sampled while it works, and the rule by which that is called a leak.

The rule: over twenty samples or more, memory has no slope that would matter, and when the work is over, file
descriptors and threads are what they were before it began.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

LEAST_SAMPLES = 20


@dataclass(frozen=True, slots=True)
class Held:
    """At one moment; what is not memory must come back to what it was."""

    at: float
    rss_kib: int
    descriptors: int
    threads: int

    @classmethod
    def of(cls, pid: int | str) -> Held:
        """What the process holds now."""
        status = dict(line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines())
        descriptors = sum(1 for _ in Path(f"/proc/{pid}/fd").iterdir())
        return cls(time.monotonic(), int(status["VmRSS"].split()[0]), descriptors, int(status["Threads"]))

    @property
    def handles(self) -> tuple[int, int]:
        """Descriptors and threads."""
        return self.descriptors, self.threads


def growth_kib(samples: Sequence[Held]) -> float:
    """By how much memory grew from the first to the last sample, as a line through all of them says.

    The line is Theil's and Sen's: the median of the slopes between all pairs, which a single jump does not move.
    """
    assert len(samples) >= LEAST_SAMPLES, "too few samples to tell"
    slopes = [
        (later.rss_kib - earlier.rss_kib) / (later.at - earlier.at)
        for number, earlier in enumerate(samples)
        for later in samples[number + 1 :]
        if later.at > earlier.at
    ]
    return statistics.median(slopes) * (samples[-1].at - samples[0].at)


def settled(pid: int, like: tuple[int, int], timeout_s: float = 20.0) -> Held:
    """What it holds when descriptors and threads are `like` they were, or after the time."""
    deadline = time.monotonic() + timeout_s
    while True:
        held = Held.of(pid)
        if held.handles == like or time.monotonic() > deadline:
            return held
        time.sleep(0.1)
