"""The cells of the site, column by column: what a table with thousands of rows costs.

A column is an object of the MIB with the rows that have it. Rules:

1. Nothing is kept of a cell but what helps to answer it again, and that only when it was asked for. Its OID is that of
   the column and the index of the row; all columns of a table with the same rows share these.
2. A cell that is a function of its device's snapshot is encoded once a snapshot at most, and not if it shows the same
   as before. Configuration, clocks and counters are encoded when they are asked for.
3. A position is that of a row in its column, from 0. A column looks at a cell in a bounded number of steps, and at all
   rows of a device that shows nothing in one.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

from gateway.core.site import Device
from gateway.faces.snmp import wire
from gateway.faces.snmp.objects import CellValue, Changes, ObjectType, Row
from gateway.faces.snmp.settings import Oid

NEVER_READ = object()


class Rows:
    """Rows in the order of their indexes, as any number of columns have them."""

    __slots__ = ("devices", "ends", "indexes", "places", "rows", "size", "suffixes")

    def __init__(self, rows: Iterable[tuple[Oid, Row]]) -> None:
        ordered = sorted(rows, key=lambda each: each[0])
        self.indexes = [index for index, _ in ordered]
        self.rows = [row for _, row in ordered]
        self.size = len(ordered)
        self.suffixes = [wire.arcs(index) for index in self.indexes]
        self.places = {suffix: at for at, suffix in enumerate(self.suffixes)}
        self.devices: list[Device | None] = [getattr(row, "device", None) for row in self.rows]
        self.ends = _ends(self.devices)  # where the rows of another device begin

    def only(self, positions: Sequence[int]) -> Rows:
        """Some of the rows."""
        return Rows((self.indexes[at], self.rows[at]) for at in positions)


def _ends(devices: Sequence[Device | None]) -> list[int]:
    ends = [len(devices)] * len(devices)
    for at in range(len(devices) - 2, -1, -1):
        ends[at] = ends[at + 1] if devices[at] is devices[at + 1] else at + 1
    return ends


class Column:
    """One object with its rows; this kind keeps nothing: configuration, clocks and counters."""

    __slots__ = ("_tag", "_wraps", "base", "object", "prefix", "rows", "size")

    def __init__(self, base: Oid, described: ObjectType, rows: Rows) -> None:
        self.base = base
        self.object = described
        self.rows = rows
        self.size = rows.size
        self.prefix = wire.arcs((base[0] * 40 + base[1], *base[2:]))
        self._tag = wire.TAGS[described.syntax]
        self._wraps = described.syntax in wire.WRAPPING

    def __iter__(self) -> Iterator[Cell]:
        return (Cell(self, at) for at in range(self.size))

    def name(self, at: int) -> bytes:
        """The encoded OID of a cell."""
        return wire.tlv(0x06, self.prefix + self.rows.suffixes[at])

    def varbind(self, at: int, now: float) -> bytes | None:
        """The encoded varbind of a cell, or None when it has no value now."""
        return self._encoded(at, self.object.get(self.rows.rows[at], now))

    def first(self, at: int, now: float) -> tuple[int, bytes] | None:
        """The first cell at `at` or behind it that has a value, or None."""
        for position in range(at, self.size):
            varbind = self.varbind(position, now)
            if varbind is not None:
                return position, varbind
        return None

    def watched(self, start: int, end: int) -> Iterable[Device] | None:
        """The devices that these cells depend on; None when they depend on more than snapshots."""
        del start, end
        return () if self.object.changes is Changes.NEVER else None

    def _encoded(self, at: int, cell: CellValue) -> bytes | None:
        if cell is None:
            return None
        return wire.varbind(self.name(at), wire.tagged(self._tag, cell, wraps=self._wraps))


class SnapshotColumn(Column):
    """One object that is a function of its device's snapshot."""

    __slots__ = ("_cells", "_of_values", "_seen", "_varbinds")

    def __init__(self, base: Oid, described: ObjectType, rows: Rows) -> None:
        super().__init__(base, described, rows)
        self._of_values = described.of_values or described.point is not None
        self._seen: list[object] = []
        self._cells: list[CellValue] = []
        self._varbinds: list[bytes | None] = []

    def varbind(self, at: int, now: float) -> bytes | None:
        """The encoded varbind of a cell, or None when it has no value now."""
        device = self.rows.devices[at]
        if device is None:
            return super().varbind(at, now)
        mark = device.snapshot.mark
        try:
            if self._seen[at] is mark:
                return self._varbinds[at]
        except IndexError:
            many = self.size
            self._seen, self._cells, self._varbinds = [NEVER_READ] * many, [None] * many, [None] * many
        cell = self.object.get(self.rows.rows[at], now)
        if cell != self._cells[at] or self._varbinds[at] is None:
            self._cells[at] = cell
            self._varbinds[at] = self._encoded(at, cell)
        self._seen[at] = mark
        return self._varbinds[at]

    def first(self, at: int, now: float) -> tuple[int, bytes] | None:
        """The first cell at `at` or behind it that has a value, or None."""
        end = self.size
        devices, ends = self.rows.devices, self.rows.ends
        while at < end:
            device = devices[at]
            if self._of_values and device is not None and not device.snapshot.shown():
                at = ends[at]
                continue
            varbind = self.varbind(at, now)
            if varbind is not None:
                return at, varbind
            at += 1
        return None

    def watched(self, start: int, end: int) -> Iterable[Device] | None:
        """The devices that these cells depend on; None when they depend on more than snapshots."""
        found = set(self.rows.devices[start:end])
        return None if None in found else [each for each in found if each is not None]


class Cell:
    """One cell that may exist."""

    __slots__ = ("_at", "_column")

    def __init__(self, column: Column, at: int) -> None:
        self._column = column
        self._at = at

    @property
    def object(self) -> ObjectType:
        """What it is."""
        return self._column.object

    @property
    def row(self) -> Row:
        """Whose it is."""
        return self._column.rows.rows[self._at]

    @property
    def oid(self) -> Oid:
        """Its name."""
        return (*self._column.base, *self._column.rows.indexes[self._at])

    def varbind(self, now: float) -> bytes | None:
        """The encoded varbind, or None when it has no value now."""
        return self._column.varbind(self._at, now)


def column_of(base: Oid, described: ObjectType, rows: Rows) -> Column:
    """The column of an object, of the kind that suits it."""
    kind = SnapshotColumn if described.changes is Changes.WITH_SNAPSHOT else Column
    return kind(base, described, rows)
