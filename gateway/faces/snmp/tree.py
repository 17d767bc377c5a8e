"""The site as a sorted list of OIDs with their varbinds.

1. The list is made once, of every cell that could exist, so the order can never change between two requests of a walk.
   GETNEXT is a bisection in the cells that have a value, and a step. That second list may hold a cell that
   lost its value (it is stepped over), never lack one that has a value: a point that appears, and a device that leaves
   or comes, make it anew, a sensor that comes and goes does not.
2. A varbind is encoded when it is first asked for and kept until what it shows changes: for ever for
   configuration, with the device's snapshot for its values, not at all for clocks and counters.
3. One request is answered with one `now` and without giving up the event loop, so it sees one state of the site.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator, Sequence

from gateway.core.site import Device
from gateway.core.snapshot import Snapshot
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


class _Shown:
    """The points of one device that the list of present cells reckons with."""

    __slots__ = ("_device", "_seen", "points")

    def __init__(self, device: Device) -> None:
        self._device = device
        self._seen: Snapshot | None = None
        self.points: frozenset[str] = frozenset()
        self.update()

    def update(self) -> bool:
        """Follow the device; True when the list must be made anew."""
        snapshot = self._device.snapshot
        if snapshot is self._seen:
            return False
        self._seen = snapshot
        shown = snapshot.shown()
        if shown.keys() <= self.points and bool(shown) == bool(self.points):
            return False
        self.points = frozenset(shown)
        return True


class Slot:
    """One cell that may exist, with its encoding of last time."""

    __slots__ = ("_row", "_seen", "_shown", "_varbind", "name", "object", "oid")

    def __init__(self, oid: Oid, described: ObjectType, row: Row, shown: _Shown | None) -> None:
        self.oid = oid
        self.name = wire.object_identifier(oid)
        self.object = described
        self._shown = shown
        self._row = row
        self._seen: object = None
        self._varbind: bytes | None = None

    def may_have_value(self) -> bool:
        """False for a point that its device does not show."""
        return self._shown is None or self.object.point in self._shown.points

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
        self._shown = {device.unit_id: _Shown(device) for device in gateway.site.devices}
        slots = [
            Slot((*group.base, described.number, 0), described, gateway, None)
            for group in groups
            for described in group.objects
        ]
        for table in tables:
            for index, row in _rows(table, gateway):
                slots += [
                    Slot(
                        (*table.base, 1, column.number, index),
                        column,
                        row,
                        self._shown[index] if column.point else None,
                    )
                    for column in table.columns
                    if column.models is None or _model(row) in column.models
                ]
        slots.sort(key=lambda slot: slot.oid)
        self._slots = slots
        self._by_oid = {slot.oid: slot for slot in slots}
        self._present: list[Slot] = []
        self._present_oids: list[Oid] = []
        self._list_present()
        self._objects = frozenset((*group.base, each.number) for group in groups for each in group.objects) | frozenset(
            (*table.base, 1, column.number) for table in tables for column in table.columns
        )
        self._depths = sorted({len(oid) for oid in self._objects})

    def __iter__(self) -> Iterator[Slot]:
        """Every slot in order, with a value or without."""
        return iter(self._slots)

    def refresh(self) -> None:
        """Look at the snapshots; called once at the beginning of a request."""
        # Not `any`: every device is to be looked at.
        if sum([shown.update() for shown in self._shown.values()]):
            self._list_present()

    def get(self, oid: Oid, now: float) -> bytes | None:
        """The varbind of exactly this OID, or None."""
        slot = self._by_oid.get(oid)
        return None if slot is None else slot.varbind(now)

    def after(self, oid: Oid, now: float) -> tuple[Oid, bytes] | None:
        """The first instantiated cell behind `oid` in lexicographic order, or None at the end."""
        present = self._present
        for position in range(bisect_right(self._present_oids, oid), len(present)):
            varbind = present[position].varbind(now)
            if varbind is not None:
                return self._present_oids[position], varbind
        return None

    def _list_present(self) -> None:
        self._present = [slot for slot in self._slots if slot.may_have_value()]
        self._present_oids = [slot.oid for slot in self._present]

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
