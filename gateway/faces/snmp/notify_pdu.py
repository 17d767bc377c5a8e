"""Writes the PDU of a trap or an inform: RFC 3416 §4.2.6 and §4.2.7."""

from __future__ import annotations

from collections.abc import Callable

from gateway.core.announcing import Announcement
from gateway.faces.snmp import notifications, wire
from gateway.faces.snmp.layout import Layout
from gateway.faces.snmp.objects import CellValue, ObjectType, Syntax, text
from gateway.faces.snmp.settings import Oid

TRAP = 0xA7
INFORM = 0xA6

_SYS_UP_TIME: Oid = (1, 3, 6, 1, 2, 1, 1, 3, 0)
_SNMP_TRAP_OID: Oid = (1, 3, 6, 1, 6, 3, 1, 1, 4, 1, 0)


class PduWriter:
    """PDUs for one kind of receiver of one site; `ticks` gives a monotonic moment as sysUpTime."""

    def __init__(self, layout: Layout, site: str, ticks: Callable[[float], int], *, inform: bool) -> None:
        self._root = layout.notifications
        self._site = site
        self._ticks = ticks
        self._kind = INFORM if inform else TRAP
        self._scalars: dict[str, tuple[Oid, ObjectType]] = {}
        for group in (*layout.groups, layout.notify):
            self._scalars.update({each.name: ((*group.base, each.number, 0), each) for each in group.objects})
        table = next(table for table in layout.tables if table.name == "pgwCondition")
        self._columns = {each.name: ((*table.base, 1, each.number), each) for each in table.columns}

    def condition(self, announcement: Announcement, sequence: int, request_id: int, now: float) -> bytes:
        """Tell of a condition."""
        watch = announcement.watch
        kind = notifications.kind_of(watch.condition, raised=announcement.raised)
        values = notifications.values_of(announcement, sequence, self._site)
        index = (watch.unit_id, watch.condition.code)
        varbinds = [self._varbind(name, values[name], index) for name in notifications.OBJECTS]
        return self._pdu((*self._root, kind.number), varbinds, request_id, now)

    def standard(self, oid: Oid, sequence: int, request_id: int, now: float) -> bytes:
        """A notification of SNMPv2-MIB."""
        values: dict[str, CellValue] = {"pgwNotifySequence": sequence, "pgwSiteName": text(self._site)}
        return self._pdu(oid, [self._varbind(name, value, ()) for name, value in values.items()], request_id, now)

    def _varbind(self, name: str, value: CellValue, index: Oid) -> bytes:
        column = self._columns.get(name)
        oid, described = (self._scalars[name]) if column is None else ((*column[0], *index), column[1])
        return wire.varbind(wire.object_identifier(oid), wire.value(described.syntax, value))

    def _pdu(self, oid: Oid, varbinds: list[bytes], request_id: int, now: float) -> bytes:
        head = [
            wire.varbind(wire.object_identifier(_SYS_UP_TIME), wire.value(Syntax.TIME_TICKS, self._ticks(now))),
            wire.varbind(wire.object_identifier(_SNMP_TRAP_OID), wire.object_identifier(oid)),
        ]
        ids = wire.integer(0x02, request_id) + wire.integer(0x02, 0) * 2
        return wire.tlv(self._kind, ids + wire.tlv(0x30, b"".join([*head, *varbinds])))
