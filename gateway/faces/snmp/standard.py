"""SNMPv2-MIB as far as a read-only agent owes it (RFC 3418): the system and the snmp group.

sysObjectID and sysDescr say truthfully that this is the gateway, whatever hangs behind it.
"""

from __future__ import annotations

from collections.abc import Callable

from gateway.faces.snmp.objects import (
    CapabilityRow,
    CellValue,
    Changes,
    Gateway,
    ObjectType,
    RowKind,
    ScalarGroup,
    Syntax,
    Table,
    text,
)
from gateway.faces.snmp.settings import Oid

SYSTEM: Oid = (1, 3, 6, 1, 2, 1, 1)
SNMP: Oid = (1, 3, 6, 1, 2, 1, 11)
SNMP_MIB: Oid = (1, 3, 6, 1, 6, 3, 1)
"""The identity of SNMPv2-MIB; only ever a value of sysORID, nothing is served there."""

APPLICATIONS = 64 + 8
"""sysServices: end-to-end and application layer, what RFC 3418 gives a host."""

_AUTHEN_TRAPS = {True: 1, False: 2}  # enabled, disabled


def _fixed(number: int, name: str, syntax: Syntax, get: Callable[..., CellValue]) -> ObjectType:
    return ObjectType(number, name, syntax, "", lambda row, _now: get(row), changes=Changes.NEVER)


def _counter(number: int, name: str, get: Callable[[Gateway], int]) -> ObjectType:
    return ObjectType(number, name, Syntax.COUNTER32, "", lambda row, _now: get(row))


def _description(gateway: Gateway) -> bytes:
    return text(f"prostar-gateway {gateway.version}: solar charge controllers on serial lines")


GROUPS: tuple[ScalarGroup, ...] = (
    ScalarGroup(
        SYSTEM,
        SYSTEM[-1],
        "system",
        "",
        (
            _fixed(1, "sysDescr", Syntax.TEXT, _description),
            _fixed(2, "sysObjectID", Syntax.OBJECT_IDENTIFIER, lambda gateway: gateway.object_id),
            ObjectType(3, "sysUpTime", Syntax.TIME_TICKS, "", lambda gateway, now: gateway.ticks(now)),
            _fixed(4, "sysContact", Syntax.TEXT, lambda gateway: text(gateway.contact)),
            _fixed(5, "sysName", Syntax.TEXT, lambda gateway: text(gateway.site.name)),
            _fixed(6, "sysLocation", Syntax.TEXT, lambda gateway: text(gateway.location)),
            _fixed(7, "sysServices", Syntax.INTEGER32, lambda _gateway: APPLICATIONS),
            _fixed(8, "sysORLastChange", Syntax.TIME_TICKS, lambda _gateway: 0),
        ),
    ),
    ScalarGroup(
        SNMP,
        SNMP[-1],
        "snmp",
        "",
        (
            _counter(1, "snmpInPkts", lambda gateway: gateway.snmp.in_packets),
            _counter(3, "snmpInBadVersions", lambda gateway: gateway.snmp.bad_versions),
            _counter(4, "snmpInBadCommunityNames", lambda gateway: gateway.snmp.bad_community_names),
            _counter(5, "snmpInBadCommunityUses", lambda gateway: gateway.snmp.bad_community_uses),
            _counter(6, "snmpInASNParseErrs", lambda gateway: gateway.snmp.parse_errors),
            _fixed(
                30,
                "snmpEnableAuthenTraps",
                Syntax.ENUMERATION,
                lambda gateway: _AUTHEN_TRAPS[gateway.authentication_traps],
            ),
            _counter(31, "snmpSilentDrops", lambda gateway: gateway.snmp.silent_drops),
            _fixed(32, "snmpProxyDrops", Syntax.COUNTER32, lambda _gateway: 0),
        ),
    ),
)


def _capability(row: CapabilityRow) -> tuple[Oid, str]:
    return row.gateway.capabilities[row.position]


CAPABILITIES = Table(
    (*SYSTEM, 9),
    9,
    "sysOR",
    "",
    RowKind.CAPABILITY,
    "sysORIndex",
    (
        _fixed(2, "sysORID", Syntax.OBJECT_IDENTIFIER, lambda row: _capability(row)[0]),
        _fixed(3, "sysORDescr", Syntax.TEXT, lambda row: text(_capability(row)[1])),
        _fixed(4, "sysORUpTime", Syntax.TIME_TICKS, lambda _row: 0),
    ),
)
