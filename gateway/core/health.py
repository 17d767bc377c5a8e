"""When a device may be asked, and what its silence means (design §7).

Rule 1: three attempts in a row without any reply open the breaker: the device is quarantined.
Rule 2: a quarantined device is probed once after 5 s, then after twice as long each time up to 60 s,
        each wait shortened by up to a tenth so that probes of many devices do not fall together.
Rule 3: any reply, an exception too, closes the breaker at once.
Rule 4: when the line was opened anew, what was quarantined is probed at once.
"""

from __future__ import annotations

from random import Random

MISSES_TO_OPEN = 3
FIRST_PROBE_S = 5.0
LAST_PROBE_S = 60.0
JITTER = 0.1


class Breaker:
    """Quarantine of one device. `rng` gives the jitter, so that a seeded run repeats itself."""

    def __init__(self, rng: Random) -> None:
        self._rng = rng
        self.misses = 0
        self.probe_at: float | None = None
        self._wait_s = FIRST_PROBE_S

    @property
    def is_open(self) -> bool:
        """Whether the device is quarantined."""
        return self.probe_at is not None

    def replied(self) -> None:
        """The device answered something (rule 3)."""
        self.misses = 0
        self.probe_at = None
        self._wait_s = FIRST_PROBE_S

    def missed(self, now: float, longest_s: float = LAST_PROBE_S) -> None:
        """An attempt ended without any reply (rules 1 and 2); the next probe waits `longest_s` at most."""
        self.misses += 1
        if self.misses < MISSES_TO_OPEN:
            return
        if self.probe_at is not None:
            self._wait_s = min(2 * self._wait_s, longest_s)
        self.probe_at = now + self._wait_s * (1 - JITTER * self._rng.random())

    def line_opened(self, now: float) -> None:
        """Probe at once (rule 4)."""
        if self.probe_at is not None:
            self.probe_at = now
            self._wait_s = FIRST_PROBE_S
