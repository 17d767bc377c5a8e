"""The site as columns of cells in the order of their OIDs.

1. The columns and their rows are made once, of every cell that could exist, so the order can never change between two
   requests of a walk. GETNEXT is a look-up or a bisection, and a step over the cells that have no value now.
2. Places are numbers of cells in that order. A step is bounded: after LEAP_AFTER columns without a value, columns of
   points that no device shows are left out whole, for the rest of the request, so that a site of silent devices costs
   one look at each device.
3. How a cell is encoded, and how long that is kept, is the column's matter (`columns.py`).
4. A view is a `Window`: a list in which everything else is missing. What is not in it cannot be found.
5. One request is answered with one `now` and without giving up the event loop, so it sees one state of the site.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import accumulate

from gateway.core.site import Device
from gateway.faces.snmp import reader
from gateway.faces.snmp.client_tail import ClientTail
from gateway.faces.snmp.columns import Cell, Column, column_of
from gateway.faces.snmp.entity import entities
from gateway.faces.snmp.layout import Layout
from gateway.faces.snmp.log_table import LogDays, LogTail
from gateway.faces.snmp.objects import (
    CapabilityRow,
    ConditionRow,
    DeviceRow,
    Gateway,
    LineRow,
    ObjectType,
    Row,
    RowKind,
    ScalarGroup,
    Table,
)
from gateway.faces.snmp.routes import Routes
from gateway.faces.snmp.rows import ARC_BITS, NumberedRows, Rows
from gateway.faces.snmp.settings import Oid, View
from gateway.faces.snmp.tails import Tail, Tails

LEAP_AFTER = 2
_SCALAR: Oid = (0,)


NO_TAILS = Tails(())


class Window:
    """The cells that one view shows of one tree, in order."""

    def __init__(
        self,
        columns: Sequence[Column],
        objects: frozenset[Oid],
        devices: Sequence[Device],
        tails: Tails = NO_TAILS,
    ) -> None:
        """`columns` in order, none of them empty, and `tails` behind them.

        `objects` are those of which noSuchInstance may be said.
        """
        self.tails = tails
        self.columns = tuple(columns)
        self.starts = [0, *accumulate(column.size for column in columns)]  # the last one is behind the end
        self.size = self.starts[-1]
        self._bases = [column.base for column in columns]
        self._numbers = {column.prefix: number for number, column in enumerate(columns)}
        # By how many octets a column is looked up, those of most cells first.
        cells: Counter[int] = Counter()
        for column in columns:
            cells[len(column.prefix)] += column.size
        self._sizes = [size for size, _ in cells.most_common()]
        self.routes = Routes(columns)
        self._objects = objects
        self._depths = sorted({len(oid) for oid in objects})
        self._devices = devices
        self._next_shown: list[int] | None = None

    def __iter__(self) -> Iterator[Cell]:
        """Every cell in order, with a value or without."""
        return (cell for column in self.columns for cell in column)

    def refresh(self) -> None:
        """Forget what was remembered of the devices; called once at the beginning of a request."""
        self._next_shown = None

    def find(self, content: bytes) -> tuple[int, int] | None:
        """Number of the column, and position in it, of the cell whose OID has these octets; None when there is none."""
        for size in self._sizes:
            number = self._numbers.get(content[:size])
            if number is not None:
                at = self.columns[number].rows.places.get(content[size:])
                return None if at is None else (number, at)
        return None

    def get(self, oid: Oid, now: float) -> bytes | None:
        """The varbind of exactly this OID, or None."""
        place = self.place_after(oid) - 1
        if place >= 0:
            number, at = self.locate(place)
            column = self.columns[number]
            if (*column.base, *column.rows.indexes[at]) == oid:
                return column.varbind(at, now)
        return self.tails.get(oid, now)

    def after(self, oid: Oid, now: float) -> tuple[Oid, bytes] | None:
        """The first instantiated cell behind `oid` in lexicographic order, or None at the end."""
        found = self.from_place(self.place_after(oid), now)
        if found is None:
            step = next(self.tails.steps(oid, now), None)
            return None if step is None else (reader.oid(step[0]), step[1])
        number, at = self.locate(found[0])
        column = self.columns[number]
        return (*column.base, *column.rows.indexes[at]), found[1]

    def place_after(self, oid: Oid) -> int:
        """The place of the first cell behind `oid`."""
        number = bisect_right(self._bases, oid) - 1
        if number < 0:
            return 0
        base = self._bases[number]
        depth = len(base)
        if oid[:depth] != base:
            return self.starts[number + 1]
        return self.starts[number] + self.columns[number].rows.behind(oid[depth:])

    def locate(self, place: int) -> tuple[int, int]:
        """Number of the column, and position in it, of a place before the end."""
        number = bisect_right(self.starts, place) - 1
        return number, place - self.starts[number]

    def from_place(self, place: int, now: float) -> tuple[int, bytes] | None:
        """The first instantiated cell at `place` or behind it with its place, or None at the end."""
        if place >= self.size:
            return None
        columns = self.columns
        number, at = self.locate(place)
        until = number + LEAP_AFTER
        while True:
            if number >= until or self._next_shown is not None:
                ahead = self._leap(number)
                number, at = ahead, at if ahead == number else 0
            if number == len(columns):
                return None
            found = columns[number].first(at, now)
            if found is not None:
                return self.starts[number] + found[0], found[1]
            number, at = number + 1, 0

    def has_object(self, oid: Oid) -> bool:
        """Whether `oid` lies in an object that the agent implements, instantiated or not (RFC 3416 §4.2.1)."""
        return any(oid[:depth] in self._objects for depth in self._depths)

    def _leap(self, number: int) -> int:
        """The first column from this one on that is not of a point that no device shows."""
        if self._next_shown is None:
            snapshots = [device.snapshot for device in self._devices]
            shown: set[str] = set().union(*(each.shown() for each in snapshots))
            shown.update(*(each.shown_texts() for each in snapshots))
            ahead = len(self.columns)
            found = [ahead]
            for at in range(len(self.columns) - 1, -1, -1):
                point = self.columns[at].object.point
                ahead = at if point is None or point in shown else ahead
                found.append(ahead)
            self._next_shown = found[::-1]
        return self._next_shown[number]


class Tree(Window):
    """Everything the agent can answer."""

    def __init__(
        self,
        gateway: Gateway,
        groups: Sequence[ScalarGroup],
        tables: Sequence[Table],
        single: Row | None = None,
        tails: Tails = NO_TAILS,
    ) -> None:
        """`single` is what the scalars are of, when not of the gateway; `tails` lie behind everything else."""
        alone = Rows([(_SCALAR, gateway if single is None else single)])
        columns = [
            column_of((*group.base, described.number), described, alone)
            for group in groups
            for described in group.objects
        ]
        made: dict[RowKind, Rows] = {}
        for table in tables:
            if table.rows not in made:
                made[table.rows] = _ROWS[table.rows](gateway)
            columns += _columns(table, made[table.rows])
        columns.sort(key=lambda column: column.base)
        objects = frozenset((*group.base, each.number) for group in groups for each in group.objects) | frozenset(
            (*table.base, 1, column.number) for table in tables for column in table.columns
        )
        if tails.tails and columns and columns[-1].base > tails.tails[0].base:
            raise ValueError(f"{columns[-1].base} lies behind a table that must be one of the last")
        super().__init__(columns, objects, gateway.site.devices, tails)

    def window(self, view: View) -> Window:
        """What `view` shows of the tree."""
        columns = [shown for column in self.columns if (shown := _shown_of(column, view)) is not None]
        tails = self.tails.through(view)
        same = len(columns) == len(self.columns) and all(map(lambda a, b: a is b, columns, self.columns))
        if same and tails is self.tails:
            return self
        return Window(columns, frozenset(oid for oid in self._objects if view.shows(oid)), self._devices, tails)


def _columns(table: Table, rows: Rows) -> Iterator[Column]:
    """The columns of a table, each with those of its rows that have it; one that no row has is left out."""
    chosen: dict[object, Rows] = {}
    for described in table.columns:
        key = described.models, described.only
        if key not in chosen:
            having = [at for at in range(rows.size) if _has(described, rows.row(at))]
            chosen[key] = rows if len(having) == rows.size else rows.only(having)
        if chosen[key].size:
            yield column_of((*table.base, 1, described.number), described, chosen[key])


def _has(described: ObjectType, row: Row) -> bool:
    return (described.models is None or _model(row) in described.models) and (
        described.only is None or described.only(row)
    )


def _shown_of(column: Column, view: View) -> Column | None:
    """What a view shows of a column; None: nothing."""
    base, indexes = column.base, column.rows.indexes
    if not any(len(each) > len(base) and each[: len(base)] == base for each in (*view.include, *view.exclude)):
        return column if view.shows(base) else None
    having = [at for at, index in enumerate(indexes) if view.shows((*base, *index))]
    return column_of(base, column.object, column.rows.only(having)) if having else None


def whole(
    layout: Layout,
    gateway: Gateway,
    groups: Sequence[ScalarGroup],
    tables: Sequence[Table],
    days: LogDays | None = None,
) -> Tree:
    """The tree of the layout together with the standard `groups` and `tables`; without `days` it has no log."""
    by_kind = {table.rows: table for table in layout.tables}
    log = by_kind[RowKind.LOG]
    own = layout.tables if days is not None else tuple(table for table in layout.tables if table is not log)
    tails: list[Tail] = [ClientTail(by_kind[RowKind.CLIENT], gateway)]
    if days is not None:
        tails.append(LogTail(log, days))
    return Tree(gateway, (*groups, *layout.groups), (*tables, *own), tails=Tails(tails))


def _conditions(gateway: Gateway) -> Rows:
    conditions = gateway.conditions
    if conditions is None:
        return Rows(())

    def row(unit: int, code: int) -> ConditionRow:
        of = conditions.devices[unit] if unit else None
        watches = conditions.gateway if of is None else of
        return ConditionRow(gateway, watches[code], of)

    numbers = (watch.unit_id << ARC_BITS | watch.condition.code for watch in conditions)

    def model(unit: int) -> int:
        return id(conditions.devices[unit].map) if unit else 0

    return NumberedRows(numbers, 1 << ARC_BITS, row, lambda _unit: None, model)


_ROWS: Mapping[RowKind, Callable[[Gateway], Rows]] = {
    RowKind.LINE: lambda gateway: Rows(
        ((index,), LineRow(gateway, line)) for index, line in enumerate(gateway.site.lines, 1)
    ),
    RowKind.DEVICE: lambda gateway: Rows(((each.unit_id,), DeviceRow(gateway, each)) for each in gateway.site.devices),
    RowKind.CONDITION: _conditions,
    RowKind.CLIENT: lambda _gateway: Rows(()),  # see client_tail.py
    RowKind.LOG: lambda _gateway: Rows(()),  # see log_table.py
    RowKind.CAPABILITY: lambda gateway: Rows(
        ((at + 1,), CapabilityRow(gateway, at)) for at in range(len(gateway.capabilities))
    ),
    RowKind.ENTITY: entities,
    RowKind.SENSOR: lambda gateway: entities(gateway, sensors_only=True),
}
"""The rows that a table of this kind will ever have."""


def _model(row: Row) -> str:
    device: Device | None = getattr(row, "device", None)
    return "" if device is None else device.map.model
