"""The stored daily log as those who show it see it: what can be asked, and in which form it comes.

A moment is `2026-11-22`, `2026-11-22T18:30` or with seconds and an offset; without an offset it is UTC. A bare date
given as the end means the end of that day, so that `since` and `until` with one date are that day.
"""

from __future__ import annotations

from collections.abc import AsyncGenerator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, date, datetime, timedelta
from enum import StrEnum
from types import MappingProxyType
from typing import Protocol

from gateway.devices.model import Value


class LogFormat(StrEnum):
    """Forms of an export."""

    CSV = "csv"
    JSON = "json"
    JSONL = "jsonl"
    OPENMETRICS = "openmetrics"


CONTENT_TYPES = MappingProxyType(
    {
        LogFormat.CSV: "text/csv; charset=utf-8; header=present",
        LogFormat.JSON: "application/json",
        LogFormat.JSONL: "application/jsonl",
        LogFormat.OPENMETRICS: "application/openmetrics-text; version=1.0.0; charset=utf-8",
    }
)


@dataclass(frozen=True, slots=True)
class Selection:
    """Which days: of one device or all, written at or after `since` and before `until` (Unix times; None: no bound).

    A bound leaves out days that have no date.
    """

    device: str | None = None
    since: float | None = None
    until: float | None = None


@dataclass(frozen=True, slots=True)
class LoggedDay:
    """A day of one controller; values are in the units of its map's log, times are Unix times."""

    hourmeter: int
    values: Mapping[str, Value]
    written_at: float | None  # None: not known
    error_s: float | None  # by how much that may be wrong, either way


class RecentDays(Protocol):
    """The newest stored days of a device."""

    async def newest(self, line: str, device: str, most: int) -> Sequence[LoggedDay]:
        """The newest days of the controller last seen there, oldest first; HistoryError when they cannot be read."""
        ...


class DayLog(Protocol):
    """The stored days of a site."""

    async def devices(self) -> frozenset[str]:
        """Names under which days are stored; HistoryError when they cannot be read."""
        ...

    def export(self, form: LogFormat, selection: Selection) -> AsyncGenerator[bytes, None]:
        """The days in pieces of some tens of kilobytes; HistoryError when they cannot be read."""
        ...


def parse_moment(text: str, *, end: bool = False) -> float:
    """Unix time of a date or a date with time; ValueError says what is allowed."""
    try:
        try:
            day = date.fromisoformat(text)
        except ValueError:
            moment = datetime.fromisoformat(text)
        else:
            moment = datetime(day.year, day.month, day.day, tzinfo=UTC) + timedelta(days=1 if end else 0)
        if moment.tzinfo is None:
            moment = moment.replace(tzinfo=UTC)
        return moment.timestamp()
    except (ValueError, OverflowError):
        allowed = "a date such as 2026-11-22 or a moment such as 2026-11-22T18:30:00Z"
        raise ValueError(f"{text!r} is no date; allowed: {allowed}") from None
