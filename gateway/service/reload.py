"""SIGHUP: the configuration and all files that it names are read again.

Rule 1: everything is read, checked and built before anything is touched. Whatever is wrong refuses the whole; every
        problem is logged, and what runs goes on untouched.
Rule 2: only what changed is changed. A line, a connection, a listener, an SNMP engine that the new configuration
        wants as before does not notice.
Rule 3: the change itself is one step of the event loop: nobody sees a mixture. Reading and building happen in a
        thread, so that nobody waits for them.
Rule 4: what a running gateway cannot change is said by key path, and stays as it was.
"""

from __future__ import annotations

import asyncio
import json
import logging
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from gateway.clock import Clock
from gateway.core.stats import ServiceStats
from gateway.errors import ConfigError, ReadingFailed
from gateway.service.changes import NEEDS_RESTART, changes
from gateway.service.garbage import set_aside
from gateway.service.gateway import Gateway
from gateway.service.logs import Log
from gateway.service.plain import with_values
from gateway.service.reading import Reading, read_config
from gateway.service.systemd import Systemd

if TYPE_CHECKING:  # what it is at run time, plain.py says
    from gateway.service.schema import Config

SHOWN = 32
"""How many changed keys, or problems, are logged at most."""

_log = logging.getLogger(__name__)


class Reloader:
    """The keeper that waits for SIGHUP; `wanted` is its handler."""

    name = "reload"

    def __init__(self, path: Path, gateway: Gateway, clock: Clock, systemd: Systemd, log: Log) -> None:
        self._path = path
        self._gateway = gateway
        self._clock = clock
        self._systemd = systemd
        self._log = log
        self._stats: ServiceStats = gateway.stats
        self._asked = asyncio.Event()

    def wanted(self) -> None:
        """Read the configuration again, as soon as a reload that is under way is over."""
        self._asked.set()

    async def run(self) -> None:
        """Reload whenever it is wanted, until cancelled."""
        while True:
            await self._asked.wait()
            self._asked.clear()
            began = self._clock.monotonic()
            self._systemd.reloading(time.monotonic())
            try:
                await self._reload(began)
            finally:
                self._systemd.ready(self._gateway.summary())

    async def _reload(self, began: float) -> None:
        gateway = self._gateway
        before, site = gateway.config, gateway.site
        try:
            config = await self._read()
            for key in (key for key in NEEDS_RESTART if getattr(config, key) != getattr(before, key)):
                _log.warning("event=reload_needs_restart key=%s kept=old", key)
            config = with_values(config, {key: getattr(before, key) for key in NEEDS_RESTART})
            async with gateway.changing:
                await self._change(config)
        except ConfigError as error:
            self._refused(error.problems)
            return
        except ReadingFailed as error:
            self._refused((str(error),))
            return
        self._log.use(config.log.level, config.log.form)
        self._stats.reloads["applied"] += 1
        self._stats.configured_at = self._clock.monotonic()
        self._stats.reload_works = True
        if gateway.site is not site:  # it takes the loop a tenth of a second: only for what lasts
            set_aside()
        changed = changes(before, config)
        _log.info('event=reloaded changed="%s" took_s=%.3f', _some(changed), self._clock.monotonic() - began)

    async def _read(self) -> Config:
        """What the file holds. Who stops meanwhile does not wait for a file that hangs: its thread would."""
        begun: list[Reading] = []
        try:
            return await asyncio.to_thread(read_config, self._path, begun.append)
        except asyncio.CancelledError:
            for reading in begun:
                reading.give_up()
            raise

    async def _change(self, config: Config) -> None:
        plan = await self._gateway.plan(config)
        try:
            await self._gateway.change(plan)
        except Exception:
            self._gateway.supervisor.give_up(self.name)  # half of it may be done: only a new start is sure
            raise

    def _refused(self, problems: Sequence[str]) -> None:
        self._stats.reloads["refused"] += 1
        self._stats.reload_works = False
        for problem in problems[:SHOWN]:
            _log.error("event=reload_problem problem=%s", json.dumps(problem, ensure_ascii=False))
        _log.error("event=reload_refused problems=%d kept=old", len(problems))


def _some(keys: Sequence[str]) -> str:
    more = f" and {len(keys) - SHOWN} more" if len(keys) > SHOWN else ""
    return ", ".join(keys[:SHOWN]).replace('"', "'") + more
