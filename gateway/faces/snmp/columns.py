"""The cells of the site, column by column: what a table with thousands of rows costs.

A column is an object of the MIB with the rows that have it. Rules:

1. Nothing is kept of a cell. Its OID is that of the column and the index of the row, its value is read where it is, and
   both are put together when it is asked for. What numbers look like is kept for all cells together (encodings.py), and
   what is alike for all devices of a model, once a model.
2. A position is that of a row in its column, from 0 (rows.py). A column looks at a cell in a bounded number of steps,
   and at all rows of a device that shows nothing in one.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Iterator, Mapping

from gateway.core.site import Device
from gateway.core.snapshot import DeviceState
from gateway.devices.model import Value
from gateway.faces.snmp import wire
from gateway.faces.snmp.objects import CellValue, Changes, ObjectType, Row
from gateway.faces.snmp.rows import NumberedRows, Rows
from gateway.faces.snmp.settings import Oid

_ONLINE = DeviceState.ONLINE


class Column:
    """One object with its rows; this kind is configuration, clocks and counters."""

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
        return wire.tlv(0x06, self.prefix + self.rows.suffix(at))

    def varbind(self, at: int, now: float) -> bytes | None:
        """The encoded varbind of a cell, or None when it has no value now."""
        return self._encoded(at, self.object.get(self.rows.row(at), now))

    def run(self, start: int, end: int, now: float) -> list[bytes]:
        """The encoded varbinds of the cells from one to before another, as far as one after the other has a value."""
        varbinds = []
        for at in range(start, end):
            varbind = self.varbind(at, now)
            if varbind is None:
                break
            varbinds.append(varbind)
        return varbinds

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
        return wire.cell(self.prefix + self.rows.suffix(at), wire.tagged(self._tag, cell, wraps=self._wraps))


class AlikeColumn(Column):
    """One object that is the same in all rows of a kind: its values are kept, one a kind."""

    __slots__ = ("_contents", "_numbered")

    def __init__(self, base: Oid, described: ObjectType, rows: NumberedRows) -> None:
        super().__init__(base, described, rows)
        self._numbered = rows
        self._contents: dict[Hashable, bytes] = {}

    def varbind(self, at: int, now: float) -> bytes | None:
        """The encoded varbind of a cell, or None when it has no value."""
        rows = self._numbered
        kind = rows.kind(at)
        content = self._contents.get(kind)
        if content is None:
            cell = self.object.get(rows.row(at), now)
            if cell is None:
                return None
            content = self._contents[kind] = wire.tagged(self._tag, cell, wraps=self._wraps)
        return wire.cell(self.prefix + rows.suffix(at), content)


class SnapshotColumn(Column):
    """One object that is a function of its device's snapshot."""

    __slots__ = ("_of_values",)

    def __init__(self, base: Oid, described: ObjectType, rows: Rows) -> None:
        super().__init__(base, described, rows)
        self._of_values = described.of_values or described.point is not None

    def first(self, at: int, now: float) -> tuple[int, bytes] | None:
        """The first cell at `at` or behind it that has a value, or None."""
        rows = self.rows
        while at < self.size:
            device = rows.device(at)
            if self._of_values and device is not None and not device.snapshot.shown():
                at = rows.end(at)
                continue
            varbind = self.varbind(at, now)
            if varbind is not None:
                return at, varbind
            at += 1
        return None

    def watched(self, start: int, end: int) -> Iterable[Device] | None:
        """The devices that these cells depend on; None when they depend on more than snapshots."""
        found = self.rows.devices(start, end)
        return None if None in found else [each for each in found if each is not None]


class PointColumn(SnapshotColumn):
    """One point whose values are numbers: the same cells, without a row and a value in the MIB being made of them."""

    __slots__ = ("_encodings", "_point")

    def __init__(
        self, base: Oid, described: ObjectType, rows: Rows, point: str, encodings: Mapping[Value, bytes]
    ) -> None:
        super().__init__(base, described, rows)
        self._point = point
        self._encodings = encodings

    def varbind(self, at: int, now: float) -> bytes | None:
        """The encoded varbind of a cell, or None when it has no value now."""
        del now
        rows = self.rows
        device = rows.device(at)
        assert device is not None
        snapshot = device.snapshot
        if snapshot.state is not _ONLINE:
            return None
        try:
            number = self._encodings[snapshot.values[self._point]]
        except KeyError:
            return None
        return wire.cell(self.prefix + rows.suffix(at), number)

    def run(self, start: int, end: int, now: float) -> list[bytes]:
        """See `Column`; pollers ask for whole columns, so this is most of what is ever encoded, and calls nothing."""
        numbers, point, prefix, heads = self._encodings, self._point, self.prefix, wire.CELLS
        before, size = b"", 0
        varbinds = []
        try:
            for device, suffix in self.rows.pairs(start, end):
                assert device is not None
                snapshot = device.snapshot
                if snapshot.state is not _ONLINE:
                    break
                cell = suffix + numbers[snapshot.values[point]]
                if len(suffix) != size:
                    size = len(suffix)
                    before = wire.head(0x06, len(prefix) + size) + prefix
                varbinds.append(heads[len(before) + len(cell)] + before + cell)
        except KeyError:  # it has no value
            pass
        except IndexError:  # longer than the ready-made heads are for
            return super().run(start, end, now)
        return varbinds


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
        return self._column.rows.row(self._at)

    @property
    def oid(self) -> Oid:
        """Its name."""
        return (*self._column.base, *self._column.rows.indexes[self._at])

    def varbind(self, now: float) -> bytes | None:
        """The encoded varbind, or None when it has no value now."""
        return self._column.varbind(self._at, now)


def column_of(base: Oid, described: ObjectType, rows: Rows) -> Column:
    """The column of an object, of the kind that suits it."""
    if described.alike and isinstance(rows, NumberedRows):
        return AlikeColumn(base, described, rows)
    if described.changes is not Changes.WITH_SNAPSHOT:
        return Column(base, described, rows)
    if described.point is not None and described.encodings is not None:
        return PointColumn(base, described, rows, described.point, described.encodings)
    return SnapshotColumn(base, described, rows)
