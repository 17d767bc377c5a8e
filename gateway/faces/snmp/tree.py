"""The site as a sorted list of OIDs with their varbinds.

1. The list is made once, of every cell that could exist, so the order can never change between two requests of a walk.
   GETNEXT is a look-up or a bisection, and a step over the cells that have no value now.
2. A step is bounded: after LEAP_AFTER cells without a value, columns of points that no device shows are left out whole,
   so that a site of silent devices costs one look at each device and each column.
3. A varbind is encoded when it is first asked for and kept until what it shows changes: for ever for
   configuration, with the device's snapshot for its values, not at all for clocks and counters.
4. A view is a `Window`: a list in which everything else is missing. What is not in it cannot be found.
5. One request is answered with one `now` and without giving up the event loop, so it sees one state of the site.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Iterator, Mapping, Sequence

from gateway.core.site import Device
from gateway.faces.snmp import wire
from gateway.faces.snmp.entity import entities
from gateway.faces.snmp.layout import Layout
from gateway.faces.snmp.objects import (
    CapabilityRow,
    CellValue,
    Changes,
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
from gateway.faces.snmp.settings import Oid, View

LEAP_AFTER = 64

_NEVER_ENCODED = object()
_CONSTANT = object()


class Slot:
    """One cell that may exist, with its encoding of last time."""

    __slots__ = (
        "_cell",
        "_device",
        "_kept",
        "_seen",
        "_tag",
        "_varbind",
        "_wraps",
        "name",
        "object",
        "oid",
        "row",
        "watched",
    )

    def __init__(self, oid: Oid, described: ObjectType, row: Row) -> None:
        self.oid = oid
        self.name = wire.object_identifier(oid)
        self.object = described
        self._tag = wire.TAGS[described.syntax]
        self._wraps = described.syntax in wire.WRAPPING
        self.row = row
        device: Device | None = getattr(row, "device", None)
        self._device = device if described.changes is Changes.WITH_SNAPSHOT else None
        self._kept = described.changes is Changes.NEVER
        self._seen: object = _NEVER_ENCODED
        # What the cell depends on: a device's snapshot, nothing, or (None) what cannot be watched.
        self.watched: object = _CONSTANT if self._kept else self._device
        self._cell: CellValue = None
        self._varbind: bytes | None = None

    def varbind(self, now: float) -> bytes | None:
        """The encoded varbind, or None when the cell has no value now."""
        device = self._device
        if device is not None:
            snapshot = device.snapshot
            if snapshot is not self._seen:
                self._encode(now)
                self._seen = snapshot
        elif self._seen is not _CONSTANT:
            self._encode(now)
            if self._kept:
                self._seen = _CONSTANT
        return self._varbind

    def _encode(self, now: float) -> None:
        cell = self.object.get(self.row, now)
        if cell == self._cell:
            return
        self._cell = cell
        self._varbind = (
            None if cell is None else wire.varbind(self.name, wire.tagged(self._tag, cell, wraps=self._wraps))
        )


class Window:
    """The cells that one view shows of one tree, in order."""

    def __init__(self, slots: Sequence[Slot], objects: frozenset[Oid], devices: Sequence[Device]) -> None:
        """`slots` in order; `objects` are those of which noSuchInstance may be said."""
        self.slots = tuple(slots)
        self._oids = [slot.oid for slot in slots]
        self.places = {slot.name: place for place, slot in enumerate(slots)}  # by encoded OID
        self._objects = objects
        self._depths = sorted({len(oid) for oid in objects})
        self._devices = devices
        self._shown: set[str] | None = None
        self._columns: list[tuple[int, str | None]] = []  # (place of its first cell, point) of each column
        described: ObjectType | None = None
        for place, slot in enumerate(slots):
            if slot.object is not described:
                described = slot.object
                self._columns.append((place, described.point))

    def __iter__(self) -> Iterator[Slot]:
        """Every slot in order, with a value or without."""
        return iter(self.slots)

    def refresh(self) -> None:
        """Forget what was remembered of the devices; called once at the beginning of a request."""
        self._shown = None

    def get(self, oid: Oid, now: float) -> bytes | None:
        """The varbind of exactly this OID, or None."""
        place = bisect_right(self._oids, oid) - 1
        return self.slots[place].varbind(now) if place >= 0 and self._oids[place] == oid else None

    def after(self, oid: Oid, now: float) -> tuple[Oid, bytes] | None:
        """The first instantiated cell behind `oid` in lexicographic order, or None at the end."""
        found = self.from_place(bisect_right(self._oids, oid), now)
        return None if found is None else (self._oids[found[0]], found[1])

    def place_after(self, oid: Oid) -> int:
        """The place of the first cell behind `oid`."""
        return bisect_right(self._oids, oid)

    def from_place(self, place: int, now: float) -> tuple[int, bytes] | None:
        """The first instantiated cell at `place` or behind it with its place, or None at the end."""
        slots = self.slots
        for at in range(place, min(place + LEAP_AFTER, len(slots))):
            varbind = slots[at].varbind(now)
            if varbind is not None:
                return at, varbind
        return self._leap(place + LEAP_AFTER, now)

    def has_object(self, oid: Oid) -> bool:
        """Whether `oid` lies in an object that the agent implements, instantiated or not (RFC 3416 §4.2.1)."""
        return any(oid[:depth] in self._objects for depth in self._depths)

    def _leap(self, place: int, now: float) -> tuple[int, bytes] | None:
        slots, columns = self.slots, self._columns
        if place >= len(slots):
            return None
        if self._shown is None:
            self._shown = set().union(*(device.snapshot.shown() for device in self._devices))
        column = bisect_right(columns, place, key=lambda each: each[0]) - 1
        for number in range(column, len(columns)):
            first, point = columns[number]
            if point is not None and point not in self._shown:
                continue
            end = columns[number + 1][0] if number + 1 < len(columns) else len(slots)
            for at in range(max(first, place), end):
                varbind = slots[at].varbind(now)
                if varbind is not None:
                    return at, varbind
        return None


class Tree(Window):
    """Everything the agent can answer."""

    def __init__(
        self, gateway: Gateway, groups: Sequence[ScalarGroup], tables: Sequence[Table], single: Row | None = None
    ) -> None:
        """`single` is what the scalars are of, when not of the gateway."""
        cells: list[tuple[Oid, ObjectType, Row]] = [
            ((*group.base, described.number, 0), described, gateway if single is None else single)
            for group in groups
            for described in group.objects
        ]
        for table in tables:
            for index, row in _ROWS[table.rows](gateway):
                cells += [
                    ((*table.base, 1, column.number, *index), column, row)
                    for column in table.columns
                    if (column.models is None or _model(row) in column.models)
                    and (column.only is None or column.only(row))
                ]
        cells.sort(key=lambda cell: cell[0])
        # Made in the order of a walk, so that neighbours in it are neighbours in memory.
        slots = [Slot(*cell) for cell in cells]
        objects = frozenset((*group.base, each.number) for group in groups for each in group.objects) | frozenset(
            (*table.base, 1, column.number) for table in tables for column in table.columns
        )
        super().__init__(slots, objects, gateway.site.devices)

    def window(self, view: View) -> Window:
        """What `view` shows of the tree."""
        slots = [slot for slot in self.slots if view.shows(slot.oid)]
        if len(slots) == len(self.slots):
            return self
        return Window(slots, frozenset(oid for oid in self._objects if view.shows(oid)), self._devices)


def whole(layout: Layout, gateway: Gateway, groups: Sequence[ScalarGroup], tables: Sequence[Table]) -> Tree:
    """The tree of the layout together with the standard `groups` and `tables`."""
    return Tree(gateway, (*groups, *layout.groups), (*tables, *layout.tables))


Rows = list[tuple[Oid, Row]]
"""Rows with the arcs of their index."""


def _conditions(gateway: Gateway) -> Rows:
    conditions = gateway.conditions
    if conditions is None:
        return []
    return [
        ((watch.unit_id, watch.condition.code), ConditionRow(gateway, watch, conditions.devices.get(watch.unit_id)))
        for watch in conditions
    ]


_ROWS: Mapping[RowKind, Callable[[Gateway], Rows]] = {
    RowKind.LINE: lambda gateway: [((line.index,), LineRow(gateway, line)) for line in gateway.site.lines],
    RowKind.DEVICE: lambda gateway: [((each.unit_id,), DeviceRow(gateway, each)) for each in gateway.site.devices],
    RowKind.CONDITION: _conditions,
    RowKind.CAPABILITY: lambda gateway: [
        ((at + 1,), CapabilityRow(gateway, at)) for at in range(len(gateway.capabilities))
    ],
    RowKind.ENTITY: lambda gateway: [((entity.index,), entity) for entity in entities(gateway)],
    RowKind.SENSOR: lambda gateway: [
        ((entity.index,), entity) for entity in entities(gateway) if entity.point is not None
    ],
}
"""The rows that a table of this kind will ever have."""


def _model(row: Row) -> str:
    device: Device | None = getattr(row, "device", None)
    return "" if device is None else device.map.model
