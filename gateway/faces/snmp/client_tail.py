"""The cells of the client table, of those rows that somebody is in."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator

from gateway.faces.snmp import wire
from gateway.faces.snmp.objects import ClientRow, Gateway, ObjectType, Table
from gateway.faces.snmp.settings import Oid, View
from gateway.faces.snmp.tails import shows_all


class ClientTail:
    """See tails.py; a view shows a column or not, and of one that it shows in part nothing."""

    def __init__(self, table: Table, gateway: Gateway, columns: tuple[ObjectType, ...] | None = None) -> None:
        """`columns` are those that are shown, None: all."""
        self.base: Oid = (*table.base, 1)
        self._table = table
        self._gateway = gateway
        self._columns = {column.number: column for column in (table.columns if columns is None else columns)}
        self._numbers = sorted(self._columns)

    def through(self, view: View) -> ClientTail:
        """What a view shows of it; itself when that is all."""
        shown = tuple(column for number, column in self._columns.items() if shows_all(view, (*self.base, number)))
        return self if len(shown) == len(self._columns) else ClientTail(self._table, self._gateway, shown)

    def get(self, oid: Oid, now: float) -> bytes | None:
        """The varbind of exactly this OID, or None."""
        depth = len(self.base)
        column = self._columns.get(oid[depth]) if oid[:depth] == self.base and len(oid) == depth + 2 else None
        return None if column is None else self._varbind(column, oid[depth + 1], now)

    def steps(self, oid: Oid, now: float) -> Iterator[tuple[bytes, bytes]]:
        """Each cell behind `oid`: its encoded name and its varbind."""
        depth = len(self.base)
        if oid[:depth] > self.base:
            return
        arcs = oid[depth:] if oid[:depth] == self.base else ()
        rows = self._gateway.clients.present(now)
        for number in self._numbers:
            if arcs and number < arcs[0]:
                continue
            at = bisect_right(rows, arcs[1]) if len(arcs) > 1 and number == arcs[0] else 0
            for row in rows[at:]:
                varbind = self._varbind(self._columns[number], row, now)
                if varbind is not None:
                    yield wire.object_identifier((*self.base, number, row)), varbind

    def _varbind(self, column: ObjectType, row: int, now: float) -> bytes | None:
        cell = column.get(ClientRow(self._gateway, row), now)
        if cell is None:
            return None
        return wire.varbind(wire.object_identifier((*self.base, column.number, row)), wire.value(column.syntax, cell))
