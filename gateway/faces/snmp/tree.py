"""The site as a sorted list of OIDs with their varbinds.

1. The list is made once, of every cell that could exist: GETNEXT is a bisection and a step, and the order can never
   change between two requests of a walk. A cell without a value is stepped over.
2. A varbind is encoded when it is first asked for and kept until what it shows changes: for ever for
   configuration, with the device's snapshot for its values, not at all for clocks and counters.
3. One request is answered with one `now` and without giving up the event loop, so it sees one state of the site.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Sequence

from gateway.faces.snmp import wire
from gateway.faces.snmp.layout import Layout
from gateway.faces.snmp.objects import (
    CapabilityRow,
    Changes,
    DeviceRow,
    Gateway,
    LineRow,
    ObjectType,
    Row,
    RowKind,
    ScalarGroup,
    Table,
)
from gateway.faces.snmp.settings import Oid

_CONSTANT = object()


class Slot:
    """One cell that may exist, with its encoding of last time."""

    __slots__ = ("_row", "_seen", "_varbind", "name", "object", "oid")

    def __init__(self, oid: Oid, described: ObjectType, row: Row) -> None:
        self.oid = oid
        self.name = wire.object_identifier(oid)
        self.object = described
        self._row = row
        self._seen: object = None
        self._varbind: bytes | None = None

    def varbind(self, now: float) -> bytes | None:
        """The encoded varbind, or None when the cell has no value now."""
        changes = self.object.changes
        if changes is Changes.ALWAYS:
            return self._encode(now)
        row = self._row
        seen = row.device.snapshot if changes is Changes.WITH_SNAPSHOT and isinstance(row, DeviceRow) else _CONSTANT
        if seen is not self._seen:
            self._varbind = self._encode(now)
            self._seen = seen
        return self._varbind

    def _encode(self, now: float) -> bytes | None:
        cell = self.object.get(self._row, now)
        return None if cell is None else wire.varbind(self.name, wire.value(self.object.syntax, cell))


class Tree:
    """Everything the agent can answer."""

    def __init__(self, gateway: Gateway, groups: Sequence[ScalarGroup], tables: Sequence[Table]) -> None:
        slots = [
            Slot((*group.base, described.number, 0), described, gateway)
            for group in groups
            for described in group.objects
        ]
        for table in tables:
            for index, row in _rows(table, gateway):
                slots += [
                    Slot((*table.base, 1, column.number, index), column, row)
                    for column in table.columns
                    if column.models is None or _model(row) in column.models
                ]
        slots.sort(key=lambda slot: slot.oid)
        self._slots = slots
        self._oids = [slot.oid for slot in slots]
        self._objects = frozenset((*group.base, each.number) for group in groups for each in group.objects) | frozenset(
            (*table.base, 1, column.number) for table in tables for column in table.columns
        )
        self._depths = sorted({len(oid) for oid in self._objects})

    def __iter__(self) -> Iterator[Slot]:
        """Every slot in order, with a value or without."""
        return iter(self._slots)

    def get(self, oid: Oid, now: float) -> bytes | None:
        """The varbind of exactly this OID, or None."""
        position = bisect_left(self._oids, oid)
        if position == len(self._oids) or self._oids[position] != oid:
            return None
        return self._slots[position].varbind(now)

    def after(self, oid: Oid, now: float) -> tuple[Oid, bytes] | None:
        """The first instantiated cell behind `oid` in lexicographic order, or None at the end."""
        slots = self._slots
        for position in range(bisect_right(self._oids, oid), len(slots)):
            varbind = slots[position].varbind(now)
            if varbind is not None:
                return self._oids[position], varbind
        return None

    def has_object(self, oid: Oid) -> bool:
        """Whether `oid` lies in an object that the agent implements, instantiated or not (RFC 3416 §4.2.1)."""
        return any(oid[:depth] in self._objects for depth in self._depths)


def whole(layout: Layout, gateway: Gateway, groups: Sequence[ScalarGroup], tables: Sequence[Table]) -> Tree:
    """The tree of the layout together with the standard `groups` and `tables`."""
    return Tree(gateway, (*groups, *layout.groups), (*tables, *layout.tables))


def _rows(table: Table, gateway: Gateway) -> list[tuple[int, Row]]:
    if table.rows is RowKind.LINE:
        return [(line.index, LineRow(gateway, line)) for line in gateway.site.lines]
    if table.rows is RowKind.DEVICE:
        return [(device.unit_id, DeviceRow(gateway, device)) for device in gateway.site.devices]
    return [(at + 1, CapabilityRow(gateway, at)) for at in range(len(gateway.capabilities))]


def _model(row: Row) -> str:
    return row.device.map.model if isinstance(row, DeviceRow) else ""
