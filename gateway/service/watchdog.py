"""Tells systemd that the gateway is alive, as long as it is, and how things stand, for `systemctl status`.

Rule 1: alive is more than that the loop turns: every task is there, and no line has had something to do for `LATE_S`
        without doing it.
Rule 2: a port that is not there and a controller that is silent are not about us: with them the gateway is alive.
Rule 3: what is found once may be a loop that was held up just now; only what is still so at the next look counts.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable

from gateway.service.systemd import Systemd

LATE_S = 10.0

_log = logging.getLogger(__name__)


class Watchdog:
    """The keeper that feeds systemd's watchdog; `stuck(most_s)` names what does not work, `summary` is for people."""

    name = "watchdog"

    def __init__(
        self,
        systemd: Systemd,
        period_s: float,
        stuck: Callable[[float], tuple[str, ...]],
        summary: Callable[[], str],
        *,
        sleep: Callable[[float], Awaitable[None]] = asyncio.sleep,
    ) -> None:
        """`period_s`: how often systemd must be told, at least."""
        self._systemd = systemd
        self._pause_s = period_s / 4
        self._stuck = stuck
        self._summary = summary
        self._sleep = sleep

    async def run(self) -> None:
        """Look and tell until cancelled."""
        before: frozenset[str] = frozenset()
        said: frozenset[str] = frozenset()
        while True:
            found = frozenset(self._stuck(LATE_S))
            if found & before:
                if found != said:
                    _log.critical('event=watchdog_not_fed stuck="%s"', ", ".join(sorted(found)))
                said = found
            else:
                self._systemd.alive(self._summary())
                said = frozenset()
            before = found
            await self._sleep(self._pause_s)
