"""What an agent has to answer, worked out again: RFC 3416 on a plain list, encoded by pysnmp, nothing kept."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable, Sequence

from pyasn1.codec.ber import encoder
from pysnmp.proto import rfc1902, rfc1905
from pysnmp.proto.api import v2c

from gateway.faces.snmp.columns import Cell
from gateway.faces.snmp.objects import CellValue, Syntax
from gateway.faces.snmp.settings import Oid, View

TYPES = {
    Syntax.INTEGER32: rfc1902.Integer32,
    Syntax.ENUMERATION: rfc1902.Integer32,
    Syntax.TEXT: rfc1902.OctetString,
    Syntax.BITS: rfc1902.OctetString,
    Syntax.OBJECT_IDENTIFIER: rfc1902.ObjectName,
    Syntax.COUNTER32: rfc1902.Counter32,
    Syntax.GAUGE32: rfc1902.Gauge32,
    Syntax.UNSIGNED32: rfc1902.Unsigned32,
    Syntax.TIME_TICKS: rfc1902.TimeTicks,
    Syntax.TIME_STAMP: rfc1902.TimeTicks,
}
MISSING = encoder.encode(rfc1905.NoSuchInstance(""))  # whether the object is known is not told apart here
END_OF_MIB_VIEW = encoder.encode(rfc1905.EndOfMibView(""))

Pairs = list[tuple[Oid, bytes]]


class Oracle:
    """The cells of `tree` that `view` shows, as they are at `now`."""

    def __init__(self, tree: Iterable[Cell], view: View, now: float) -> None:
        shown = [cell for cell in tree if view.shows(cell.oid)]
        found = [(cell.oid, cell.object.syntax, cell.object.get(cell.row, now)) for cell in shown]
        self._cells = {oid: (syntax, value) for oid, syntax, value in found if value is not None}
        self._oids = sorted(self._cells)

    def ask(self, kind: type, names: Sequence[Oid], bulk: tuple[int, int]) -> Pairs:
        """All varbinds of the response, however many octets they take."""
        if kind is v2c.GetRequestPDU:
            return [self._get(name) for name in names]
        if kind is v2c.GetNextRequestPDU:
            return [self._next(name) for name in names]
        single = min(bulk[0], len(names))
        pairs = [self._next(name) for name in names[:single]]
        row = list(names[single:])
        for _ in range(bulk[1] if row else 0):
            step = [self._next(name) for name in row]
            pairs += step
            row = [name for name, _ in step]
            if all(value == END_OF_MIB_VIEW for _, value in step):
                break
        return pairs

    def _get(self, name: Oid) -> tuple[Oid, bytes]:
        return name, encoded(*self._cells[name]) if name in self._cells else MISSING

    def _next(self, name: Oid) -> tuple[Oid, bytes]:
        at = bisect_right(self._oids, name)
        if at == len(self._oids):
            return name, END_OF_MIB_VIEW
        found = self._oids[at]
        return found, encoded(*self._cells[found])


def encoded(syntax: Syntax, value: CellValue) -> bytes:
    """A value by pysnmp's classes."""
    if syntax in {Syntax.COUNTER32, Syntax.TIME_TICKS, Syntax.TIME_STAMP}:
        assert isinstance(value, int)
        value %= 2**32
    octets: bytes = encoder.encode(TYPES[syntax](value))
    return octets
