"""The devices of a line that are controlled by values which must be written again and again."""

from __future__ import annotations

from gateway.core.device_record import DeviceRecord
from gateway.core.polling import Polling
from gateway.devices.model import Point


class Rewrites:
    """Which they are; most lines have none, and looking costs them nothing."""

    def __init__(self, polling: Polling) -> None:
        self._polling = polling
        self._records: list[DeviceRecord] = []

    def written(self, record: DeviceRecord, point: Point, value: int, now: float) -> None:
        """Such a point was, or may have been, written."""
        if point.released.held_by(value, held=point.name in record.rewrites):
            record.rewrites[point.name] = now
        else:
            record.rewrites.pop(point.name, None)
        self._polling.watch_rewrites(record, now)
        self._records = [each for each in self._records if each is not record]
        if record.rewrites:
            self._records.append(record)

    def watch(self, now: float) -> None:
        """Raise the warnings that are due."""
        for record in self._records:
            self._polling.watch_rewrites(record, now)

    def moments(self) -> list[float]:
        """When they will be."""
        moments = [self._polling.next_warning(record) for record in self._records]
        return [moment for moment in moments if moment is not None]
