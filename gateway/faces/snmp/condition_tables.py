"""The condition table, and what stands of conditions in the other tables.

Numbers are append-only (mibs/oids.lock); a new object takes the next free one.
"""

from __future__ import annotations

from collections.abc import Callable

from gateway.core.conditions import ConditionState, Severity
from gateway.faces.snmp.objects import (
    CellValue,
    Changes,
    ConditionRow,
    Convention,
    DeviceRow,
    Gateway,
    Index,
    ObjectType,
    Syntax,
    text,
)

NONE = 0
"""Severity where nothing is raised."""

SEVERITY = Convention(
    "PgwSeverityCode",
    Syntax.ENUMERATION,
    ((NONE, "none"), (Severity.INFO, "info"), (Severity.WARNING, "warning"), (Severity.CRITICAL, "critical")),
    "How bad a condition is. none(0): no condition is raised.",
)
STATE = Convention(
    "PgwConditionStateCode",
    Syntax.ENUMERATION,
    ((ConditionState.CLEAR, "clear"), (ConditionState.RAISED, "raised"), (ConditionState.UNKNOWN, "unknown")),
    "Whether a condition holds. unknown(3): nobody can tell, because the device is not online or was never heard.",
)

INDEXES = (
    Index(1, "pgwConditionUnitId", 0, 247, "Unit id of the device; 0 for the gateway itself and its lines."),
    Index(
        2,
        "pgwConditionCode",
        1,
        65535,
        "Number of the condition: 100 + the bit of an array fault, 200 + the bit of a load fault, 300 + the bit of an "
        "alarm, 500 + the bit of a fault of a TriStar, 600 + the bit of its alarm, 401 to 449 what the gateway sees of "
        "a device, 451 to 499 of itself, 1000 + the index of a line.",
    ),
)


def _fixed(number: int, name: str, syntax: Syntax, description: str, get: Callable[..., CellValue]) -> ObjectType:
    return ObjectType(
        number, name, syntax, description, lambda row, _now: get(row.watch.condition), changes=Changes.NEVER, alike=True
    )


def _look(row: ConditionRow, now: float) -> None:
    if row.of is not None:
        row.of.look(now)


def _state(row: ConditionRow, now: float) -> int:
    _look(row, now)
    return row.watch.state


def _last_change(row: ConditionRow, now: float) -> int:
    _look(row, now)
    return row.gateway.ticks(row.watch.changed_at)


def _count(row: ConditionRow, now: float) -> int:
    _look(row, now)
    return row.watch.times


CONDITION: tuple[ObjectType, ...] = (
    _fixed(3, "pgwConditionName", Syntax.TEXT, "Name of the condition.", lambda each: text(each.name)),
    _fixed(4, "pgwConditionText", Syntax.TEXT, "What the condition is, for people.", lambda each: text(each.text)),
    ObjectType(
        5,
        "pgwConditionSeverity",
        Syntax.ENUMERATION,
        "How bad the condition is when it is raised.",
        lambda row, _now: row.watch.condition.severity,
        convention=SEVERITY,
        changes=Changes.NEVER,
        alike=True,
    ),
    ObjectType(6, "pgwConditionState", Syntax.ENUMERATION, "Whether the condition holds.", _state, convention=STATE),
    ObjectType(
        7,
        "pgwConditionLastChange",
        Syntax.TIME_STAMP,
        "sysUpTime when pgwConditionState last changed.",
        _last_change,
    ),
    ObjectType(
        8,
        "pgwConditionCount",
        Syntax.COUNTER32,
        "How often the condition was raised since the gateway started.",
        _count,
    ),
)


def _active_of(row: DeviceRow, now: float) -> int | None:
    if row.gateway.conditions is None:
        return None
    conditions = row.gateway.conditions.devices[row.device.unit_id]
    conditions.look(now)
    return sum(conditions.active.values())


def _worst_of(row: DeviceRow, now: float) -> int | None:
    if row.gateway.conditions is None:
        return None
    conditions = row.gateway.conditions.devices[row.device.unit_id]
    conditions.look(now)
    return conditions.worst or NONE


DEVICE: tuple[ObjectType, ...] = (
    ObjectType(
        26,
        "pgwDeviceConditions",
        Syntax.GAUGE32,
        "Number of conditions of the device that are raised now (see pgwConditionTable).",
        _active_of,
    ),
    ObjectType(
        27,
        "pgwDeviceSeverity",
        Syntax.ENUMERATION,
        "The worst severity of a condition of the device that is raised now.",
        _worst_of,
        convention=SEVERITY,
    ),
)


def _active(gateway: Gateway, now: float) -> int | None:
    conditions = gateway.conditions
    if conditions is None:
        return None
    active = sum(conditions.gateway.active.values())
    for each in conditions.devices.values():
        each.look(now)
        active += sum(each.active.values())
    return active


def _worst(gateway: Gateway, now: float) -> int | None:
    conditions = gateway.conditions
    if conditions is None:
        return None
    worst = conditions.gateway.worst or NONE
    for each in conditions.devices.values():
        each.look(now)
        worst = max(worst, each.worst or NONE)
    return worst


GATEWAY: tuple[ObjectType, ...] = (
    ObjectType(
        8,
        "pgwConditionsActive",
        Syntax.GAUGE32,
        "Number of conditions that are raised now, of the gateway, its lines and all devices.",
        _active,
    ),
    ObjectType(
        9,
        "pgwSeverity",
        Syntax.ENUMERATION,
        "The worst severity of a condition that is raised now.",
        _worst,
        convention=SEVERITY,
    ),
)
