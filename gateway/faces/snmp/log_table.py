"""The log table: the newest days of each device, from the history.

It is the last table of the tree and by far the largest, so its cells are not slots: they are kept as plain numbers and
written when they are asked for. Rules:

1. A cell that has no value is not kept, so a step is a bisection, whatever is missing.
2. Days come in whole: those of a device are read in a thread (log_keeper.py) and put in place at once.
3. What a view shows is decided for each column of each device. A view that names single days is not honoured
   by showing more: what is not shown whole is not shown.
"""

from __future__ import annotations

from array import array
from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice

from gateway.core.daylog import LoggedDay
from gateway.devices.model import DeviceMap
from gateway.faces.snmp import log_columns, wire
from gateway.faces.snmp.objects import ObjectType, Syntax, Table, in_range
from gateway.faces.snmp.settings import Oid, View
from gateway.faces.snmp.tails import shows_all

MOST_DAYS = 256


@dataclass(frozen=True, slots=True)
class Column:
    """A column of one device: hourmeters, rising, with the numbers of the cells; `octets` of a bit field."""

    hours: Sequence[int]
    numbers: Sequence[int]
    octets: int = 0


Days = Mapping[int, Column]
"""The days of one device by number of the column; no column is empty."""


def days_of(device_map: DeviceMap, days: Iterable[LoggedDay]) -> Days:
    """The columns of days that are given oldest first."""
    cells: dict[int, tuple[list[int], list[int], int]] = {}

    def add(column: int, hours: int, number: int | None, octets: int = 0) -> None:
        if number is not None:
            entry = cells.setdefault(column, ([], [], octets))
            entry[0].append(hours)
            entry[1].append(number)

    fields = () if device_map.log is None else device_map.log.fields
    for day in days:
        if not in_range(Syntax.UNSIGNED32, day.hourmeter):
            continue
        add(log_columns.WRITTEN, day.hourmeter, _seconds(day.written_at))
        add(log_columns.WRITTEN_ERROR, day.hourmeter, None if day.written_at is None else _seconds(day.error_s))
        for field in fields:
            if field.column is not None:
                number = log_columns.number_of(field, day.values.get(field.name))
                add(field.column, day.hourmeter, number, 2 * field.words if field.bits is not None else 0)
    return {
        column: Column(array("q", hours), array("q", numbers), octets)
        for column, (hours, numbers, octets) in cells.items()
    }


class LogDays:
    """The days of all devices; `version` counts how often a device got columns, or lost some."""

    def __init__(self) -> None:
        self.by_unit: dict[int, Days] = {}
        self.version = 0

    def put(self, unit_id: int, days: Days) -> None:
        """The days of a device are these."""
        if self.by_unit.get(unit_id, {}).keys() != days.keys():
            self.version += 1  # days more or less leave the order of a walk as it is
        self.by_unit[unit_id] = days


class LogTail:
    """The cells of the log table behind those of a tree, as far as `view` shows them; None: all."""

    def __init__(self, table: Table, days: LogDays, view: View | None = None) -> None:
        self.base: Oid = (*table.base, 1)
        self._table = table
        self._objects: dict[int, ObjectType] = {column.number: column for column in table.columns}
        self._days = days
        self._view = view
        self._keys: list[tuple[int, int]] = []  # column and unit id, in the order of a walk
        self._version = -1
        self._shown: dict[tuple[int, int], bool] = {}  # by key; a view does not change

    def through(self, view: View) -> LogTail:
        """What a view shows of it."""
        if shows_all(view, self.base):
            return self
        return LogTail(self._table, self._days, view)

    def get(self, oid: Oid, now: float) -> bytes | None:
        """The varbind of exactly this OID, or None."""
        del now
        depth = len(self.base)
        if oid[:depth] != self.base or len(oid) != depth + 3:
            return None
        column, unit, hour = oid[depth:]
        cells = self._cells(column, unit)
        if cells is None or not self._shows(column, unit):
            return None
        at = bisect_left(cells.hours, hour)
        if at == len(cells.hours) or cells.hours[at] != hour:
            return None
        content = wire.value(self._objects[column].syntax, _cell(cells, at))
        return wire.varbind(wire.object_identifier(oid), content)

    def steps(self, oid: Oid, now: float) -> Iterator[tuple[bytes, bytes]]:
        """Each cell behind `oid`: its encoded name and its varbind."""
        del now
        keys = self._current()
        by_unit = self._days.by_unit
        start, place = self._behind(oid, keys)
        for column, unit in islice(keys, start, None):
            cells = by_unit[unit][column]
            prefix = wire.object_identifier((*self.base, column, unit))[2:]
            syntax = self._objects[column].syntax
            for at in range(place, len(cells.hours)):
                name = wire.tlv(0x06, prefix + wire.arcs((cells.hours[at],)))
                yield name, wire.varbind(name, wire.value(syntax, _cell(cells, at)))
            place = 0

    def _behind(self, oid: Oid, keys: list[tuple[int, int]]) -> tuple[int, int]:
        """Where a walk behind `oid` begins: position in `keys` and in the column of that key."""
        depth = len(self.base)
        if oid[:depth] > self.base:
            return len(keys), 0
        arcs = oid[depth:] if oid[:depth] == self.base else ()
        if not arcs:
            return 0, 0
        key = (arcs[0], arcs[1] if len(arcs) > 1 else -1)
        at = bisect_left(keys, key)
        if len(arcs) < 3 or at == len(keys) or keys[at] != key:
            return at, 0
        return at, bisect_right(self._days.by_unit[key[1]][key[0]].hours, arcs[2])

    def _current(self) -> list[tuple[int, int]]:
        days = self._days
        if self._version != days.version:
            self._keys = sorted(
                (column, unit)
                for unit, columns in days.by_unit.items()
                for column in columns
                if self._shows(column, unit)
            )
            self._version = days.version
        return self._keys

    def _shows(self, column: int, unit: int) -> bool:
        """Rule 3."""
        view = self._view
        if column not in self._objects:
            return False
        if view is None:
            return True
        key = (column, unit)
        shown = self._shown.get(key)
        if shown is None:
            shown = self._shown[key] = shows_all(view, (*self.base, column, unit))
        return shown

    def _cells(self, column: int, unit: int) -> Column | None:
        return self._days.by_unit.get(unit, {}).get(column)


def _cell(cells: Column, place: int) -> int | bytes:
    number = cells.numbers[place]
    if not cells.octets:
        return number
    # RFC 2578 §7.1.4: bit 0 is the most significant bit of the first octet.
    return int(f"{number:0{8 * cells.octets}b}"[::-1], 2).to_bytes(cells.octets, "big")


def _seconds(value: float | None) -> int | None:
    number = None if value is None else round(value)
    return number if number is not None and in_range(Syntax.UNSIGNED32, number) else None
