"""The stored days for the faces: reads in threads, so that the loop never waits for a disk."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, Mapping, Sequence
from pathlib import Path

from gateway.core.daylog import LogFormat, LoggedDay, Selection
from gateway.history.export import export
from gateway.history.reader import HistoryReader


class HistorySource:
    """Satisfies `core.daylog.DayLog` and `RecentDays` for the history in one directory."""

    def __init__(self, directory: Path, site: str, behind: Mapping[str, str] | None = None) -> None:
        """`behind`: lines behind which there is another site, and its name."""
        self._directory = directory
        self._behind = behind
        self._site = site

    async def devices(self) -> frozenset[str]:
        """See `DayLog.devices`."""
        return await asyncio.to_thread(self._devices)

    async def newest(self, line: str, device: str, most: int) -> Sequence[LoggedDay]:
        """See `RecentDays.newest`."""
        return await asyncio.to_thread(self._newest, line, device, most)

    async def export(self, form: LogFormat, selection: Selection) -> AsyncGenerator[bytes, None]:
        """See `DayLog.export`."""
        reader = await asyncio.to_thread(HistoryReader, self._directory, self._behind)
        pieces = export(reader, form, selection, self._site)
        reading: asyncio.Task[str | None] | None = None
        try:
            while True:
                reading = asyncio.create_task(asyncio.to_thread(next, pieces, None))
                piece = await asyncio.shield(reading)
                if piece is None:
                    return
                yield piece.encode()
        finally:
            if reading is not None and not reading.done():
                await asyncio.wait([reading])  # a connection must not be closed under a thread that reads it
            await asyncio.to_thread(reader.close)

    def _newest(self, line: str, device: str, most: int) -> Sequence[LoggedDay]:
        with HistoryReader(self._directory) as reader:
            return reader.newest(line, device, most)

    def _devices(self) -> frozenset[str]:
        with HistoryReader(self._directory) as reader:
            return reader.devices()
