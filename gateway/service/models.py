"""Models that are found at work: when a device has said what it is, the faces are put together anew for it.

Rule 1: its line finds the model and changes the device's map at once (core/polling.py); from then on it is polled as
        any other. What the faces keep by model is of the maps that the site had when they were made.
Rule 2: so they are made again, as when a configuration is read again: listeners, connections, lines and devices stay.
        It happens once for each device that was found, and for those together that are found within LOOK_S.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable

from gateway.core.site import Site

LOOK_S = 0.25

_log = logging.getLogger(__name__)


class ModelKeeper:
    """Runs until cancelled: `show` is called whenever the `site` of that moment is outdated."""

    name = "models"

    def __init__(
        self,
        site: Callable[[], Site],
        show: Callable[[], Awaitable[None]],
        sleep: Callable[[float], Awaitable[None]] = asyncio.sleep,
    ) -> None:
        self._site = site
        self._show = show
        self._sleep = sleep

    async def run(self) -> None:
        """Look again and again."""
        while True:
            site = self._site()
            if site.outdated:
                await self._show()
                known = {device.name: device.map.model for device in site.devices if device.auto}
                _log.info('event=models_shown models="%s"', ", ".join(f"{name}: {known[name]}" for name in known))
            await self._sleep(LOOK_S)
