"""Keeps the conditions (core/conditions.py) up to date and tells their changes.

Rule 1: every TICK_S all lines and devices are looked at, which is no more than a comparison where nothing changed. No
        controller's values come more often than that.
Rule 2: `state_dir` is looked at every PROBE_S in a thread: a disk that hangs holds nobody up.
"""

from __future__ import annotations

import asyncio
import logging
import os
from collections.abc import Awaitable, Callable, Sequence
from pathlib import Path

from gateway.clock import Clock
from gateway.core.conditions import DOWN_S, HISTORY_DOWN, NOT_READY, STATE_DIR, Condition, Conditions, Watch
from gateway.core.site import Site
from gateway.core.stats import HistoryStats

TICK_S = 0.2
PROBE_S = 30.0
FREE_OCTETS = 1 << 20
"""`state_dir` is full when fewer are free."""

_log = logging.getLogger(__name__)

Told = Callable[[Sequence[Watch], float], None]
"""Is given the conditions that changed, and when."""


def why_unusable(directory: Path) -> str:
    """Why no files can be written in the directory, as far as can be told without writing one; blocks on the disk.

    Empty when they can. One that is missing is made by whoever needs it first, so its nearest parent is looked at.
    """
    try:
        while not directory.exists():
            directory = directory.parent
        filesystem = os.statvfs(directory)
        if filesystem.f_bavail * filesystem.f_frsize < FREE_OCTETS:
            return f"{directory}: less than {FREE_OCTETS >> 20} MiB is free"
        if filesystem.f_flag & os.ST_RDONLY:
            return f"{directory}: is on a read-only file system"
        if not os.access(directory, os.W_OK | os.X_OK):
            return f"{directory}: belongs to uid {directory.stat().st_uid}, and uid {os.geteuid()} may not write there"
    except OSError as error:
        return f"{directory}: {error.strerror or error}"
    return ""


class ConditionKeeper:
    """Runs until cancelled; `not_ready` gives the reasons why the gateway is not ready."""

    name = "conditions"

    def __init__(
        self,
        site: Site,
        clock: Clock,
        *,
        not_ready: Callable[[], Sequence[str]],
        history: HistoryStats | None,
        state_dir: Path,
        sleep: Callable[[float], Awaitable[None]] = asyncio.sleep,
    ) -> None:
        self.conditions = self.of(site, history, clock.monotonic())
        self.told: Told | None = None
        self._clock = clock
        self._not_ready = not_ready
        self._history = history
        self._state_dir = state_dir
        self._sleep = sleep

    @staticmethod
    def of(site: Site, history: HistoryStats | None, now: float, before: Conditions | None = None) -> Conditions:
        """The conditions of a site; `history` None where none is kept."""
        own: list[Condition] = [STATE_DIR, NOT_READY]
        if history is not None:
            own.insert(0, HISTORY_DOWN)
        return Conditions(site, own, now, before)

    def adjust(self, conditions: Conditions, history: HistoryStats | None) -> None:
        """Keep these from now on."""
        self.conditions = conditions
        self._history = history

    async def run(self) -> None:
        """Look again and again."""
        async with asyncio.TaskGroup() as group:
            group.create_task(self._probe())
            while True:
                self.look()
                await self._sleep(TICK_S)

    def look(self) -> None:
        """Bring the conditions up to date and tell what changed."""
        now = self._clock.monotonic()
        gateway = self.conditions.gateway
        gateway.tell(NOT_READY, raised=bool(self._not_ready()), now=now, after_s=DOWN_S)
        if self._history is not None:
            gateway.tell(HISTORY_DOWN, raised=not self._history.store_up, now=now)
        self.conditions.look(now)
        changed = self.conditions.take()
        for watch in changed:
            _log.debug("event=condition unit_id=%d %s=%s", watch.unit_id, watch.condition.name, watch.state.name)
        if changed and self.told is not None:
            self.told(changed, now)

    async def _probe(self) -> None:
        told, since = "", 0.0
        while True:
            reason = await asyncio.to_thread(why_unusable, self._state_dir)
            now = self._clock.monotonic()
            self.conditions.gateway.tell(STATE_DIR, raised=bool(reason), now=now)
            if reason and not told:
                _log.error('event=state_dir_unusable reason="%s"', reason.replace('"', "'"))
                since = now
            elif told and not reason:
                _log.info("event=state_dir_usable lasted_s=%.1f", now - since)
            told = reason
            await self._sleep(PROBE_S)
