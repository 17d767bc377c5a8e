"""Fills the log table from the history whenever a log was harvested or dates moved; runs until it is cancelled."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable

from gateway.core.daylog import RecentDays
from gateway.core.site import Device, Site
from gateway.core.stats import HistoryStats
from gateway.errors import HistoryError
from gateway.faces.snmp.log_table import MOST_DAYS, Days, LogDays, days_of

CHECK_S = 10.0

_log = logging.getLogger(__name__)


class LogKeeper:
    """The newest days of every device of a site."""

    name = "log table"

    def __init__(
        self,
        site: Site,
        source: RecentDays,
        stats: HistoryStats,
        *,
        sleep: Callable[[float], Awaitable[None]] = asyncio.sleep,
    ) -> None:
        self.days = LogDays()
        self._site = site
        self._source = source
        self._stats = stats
        self._sleep = sleep
        self._seen: dict[int, object] = {}

    def fits(self, site: Site, stats: HistoryStats) -> bool:
        """Whether it is the keeper for these."""
        return site is self._site and stats is self._stats

    async def run(self) -> None:
        """Look again and again whether something was stored."""
        while True:
            await self.look()
            await self._sleep(CHECK_S)

    async def look(self) -> None:
        """Read the days of the devices whose log was harvested, or dated anew, since the last time."""
        for device in self._site.devices:
            stats = self._stats.devices.get(device.unit_id)
            if stats is None or stats.days is None:
                continue
            state = (stats.days, stats.harvested_at, self._stats.moved)
            if self._seen.get(device.unit_id) == state:
                continue
            try:
                days = await self._read(device)
            except HistoryError as error:  # told by the history itself; tried again
                _log.debug('event=log_table_not_read device=%s reason="%s"', device.name, error)
                continue
            self._seen[device.unit_id] = state
            self.days.put(device.unit_id, days)

    async def _read(self, device: Device) -> Days:
        days = await self._source.newest(device.line.name, device.name, MOST_DAYS)
        return await asyncio.to_thread(days_of, device.map, days)
