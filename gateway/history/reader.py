"""Reading what is stored, beside a gateway that goes on writing. Synchronous; a reader shows one moment of it.

Days come by device, controller and hourmeter. Of one controller the times given out rise strictly, although each is
an estimate: where two would not, the later day is put a second after the earlier one.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from gateway.core.daylog import LoggedDay, Selection
from gateway.devices.model import Value
from gateway.history.database import FILE_NAME, explained, open_for_reading

_CONTROLLER = "identity, model, serial, line, device, unit_id"
_BATCH = 256


@dataclass(frozen=True, slots=True)
class Owner:
    """A controller, where it was last seen."""

    identity: str
    model: str
    serial: str
    line: str
    device: str
    unit_id: int
    site: str | None = None  # where its line leads to another site than the history's


@dataclass(frozen=True, slots=True)
class StoredDay:
    """A day of the history; times are Unix times, None where they are not known."""

    owner: Owner
    hourmeter: int
    slot: int
    words: bytes
    values: Mapping[str, Value]
    harvested_at: float
    written_at: float | None
    error_s: float | None


@dataclass(frozen=True, slots=True)
class StoredApart:
    """A block that was kept apart."""

    owner: Owner
    hourmeter: int
    slot: int
    words: bytes
    why: str


class HistoryReader:
    """The history in one directory; HistoryError when it cannot be opened or read. Closes as a context manager."""

    def __init__(self, directory: Path, behind: Mapping[str, str] | None = None) -> None:
        """`behind`: lines behind which there is another site, and its name."""
        self._behind = behind or {}
        self._path = directory / FILE_NAME
        self._db = open_for_reading(directory)
        self._db.execute("BEGIN")  # the first look at the file is the moment

    def close(self) -> None:
        """Close the file."""
        self._db.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def devices(self) -> frozenset[str]:
        """The devices at which a controller was last seen."""
        with explained(self._path):
            return frozenset(row[0] for row in self._db.execute("SELECT DISTINCT device FROM controller"))

    def models(self, selection: Selection) -> tuple[str, ...]:
        """The models of the controllers selected, sorted."""
        with explained(self._path):
            rows = self._db.execute(
                "SELECT DISTINCT model FROM controller WHERE device = coalesce(?, device) ORDER BY model",
                (selection.device,),
            )
            return tuple(row[0] for row in rows)

    def count(self, selection: Selection) -> int:
        """How many days `days` gives."""
        where, values = _where(selection)
        with explained(self._path):
            found = self._db.execute(f"SELECT count(*) {where}", values).fetchone()
            return int(found[0])

    def days(self, selection: Selection) -> Iterator[StoredDay]:
        """The days selected, in the order of this file's first words."""
        where, values = _where(selection)
        what = f"{_CONTROLLER}, hourmeter, slot, words, fields, read_wall, written_wall, error_s"
        last: tuple[Owner, float] | None = None
        with explained(self._path):
            cursor = self._db.execute(
                f"SELECT {what} {where} ORDER BY device, key, hourmeter",
                values,
            )
            while rows := cursor.fetchmany(_BATCH):
                for *who, hourmeter, slot, words, fields, harvested, written, error_s in rows:
                    owner = self._owner(who)
                    at = written
                    if at is not None:
                        if last is not None and last[0] == owner and at <= last[1]:
                            at = last[1] + 1.0
                        last = (owner, at)
                    yield StoredDay(owner, hourmeter, slot, bytes(words), json.loads(fields), harvested, at, error_s)

    def newest(self, line: str, device: str, most: int) -> list[LoggedDay]:
        """The newest days of the controller that was last seen at a device, oldest first."""
        with explained(self._path):
            rows = self._db.execute(
                "SELECT hourmeter, fields, written_wall, error_s FROM day WHERE controller = "
                "(SELECT key FROM controller WHERE line = ? AND device = ? ORDER BY look_wall DESC, key DESC LIMIT 1) "
                "ORDER BY hourmeter DESC LIMIT ?",
                (line, device, most),
            )
            found = [LoggedDay(hours, json.loads(fields), written, error_s) for hours, fields, written, error_s in rows]
        return found[::-1]

    def _owner(self, row: Sequence[Any]) -> Owner:
        owner = Owner(*row)
        return replace(owner, site=self._behind[owner.line]) if owner.line in self._behind else owner

    def apart(self, selection: Selection) -> Iterator[StoredApart]:
        """The blocks kept apart of the devices selected; they have no date."""
        with explained(self._path):
            rows = self._db.execute(
                f"SELECT {_CONTROLLER}, hourmeter, slot, words, why FROM apart JOIN controller ON key = controller "  # noqa: S608  # only our own text
                "WHERE device = coalesce(?, device) ORDER BY device, key, hourmeter, slot",
                (selection.device,),
            )
            for *who, hourmeter, slot, words, why in rows:
                yield StoredApart(self._owner(who), hourmeter, slot, bytes(words), why)


def _where(selection: Selection) -> tuple[str, tuple[object, ...]]:
    text = (
        "FROM day JOIN controller ON key = controller WHERE device = coalesce(?, device) "
        "AND (? IS NULL OR written_wall >= ?) AND (? IS NULL OR written_wall < ?)"
    )
    return text, (selection.device, selection.since, selection.since, selection.until, selection.until)
