"""LibreNMS definitions of the gateway: how it is recognised, and what its own MIB adds to ENTITY-SENSOR-MIB.

Volts, amperes, watts and degrees are discovered without any of this (`faces/snmp/entity.py`), so they are not named
here, or each would be there twice. Added are states, conditions and totals.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from gateway.core.conditions import ConditionState, Severity
from gateway.devices.model import DeviceMap, Group, Point
from gateway.devices.schema import load_map, models
from gateway.faces.snmp.layout import Layout, shipped_layout
from gateway.faces.snmp.objects import ObjectType, Table
from gateway.faces.snmp.settings import DEFAULT_ROOT, Oid
from gateway.generate.mib import MIB
from gateway.generate.yaml import Node, dump

FOLDER = "deploy/nms/librenms"
OS = "prostar-gateway"

OK, WARNING, CRITICAL, UNKNOWN = range(4)
"""LibreNMS' generic states."""

_STATES_OF_A_DEVICE = {"online": OK, "stale": WARNING, "offline": CRITICAL, "unknown": UNKNOWN}
_SEVERITIES = {"none": OK, "info": OK, "warning": WARNING, "critical": CRITICAL}
_BROKEN = "fault"
"""A state of this name is a failure in every enumeration."""

_CLASSES = {"kWh": ("power_consumed", ""), "Ah": ("count", " (Ah)")}
"""Sensor class and what the name needs to say, by the unit of a total."""

_MARK = "# Made by `prostar-gateway generate` from the device maps. Do not edit.\n"


def librenms_outputs(root: Oid = DEFAULT_ROOT) -> dict[str, str]:
    """Both definitions, by path from the repository; `root` as for the MIB."""
    described = shipped_layout(root)
    detection: dict[str, Node] = {
        "os": OS,
        "text": "ProStar gateway",
        "type": "power",
        "mib_dir": OS,
        "over": [
            {"graph": "device_voltage", "text": "Voltage"},
            {"graph": "device_current", "text": "Current"},
        ],
        "discovery": [{"sysObjectID": [f".{_dotted(described.product)}"]}],
    }
    return {
        f"{FOLDER}/os_detection/{OS}.yaml": _MARK + dump(detection),
        f"{FOLDER}/os_discovery/{OS}.yaml": _MARK + dump(_discovery(described, [load_map(each) for each in models()])),
    }


def _discovery(described: Layout, maps: Sequence[DeviceMap]) -> dict[str, Node]:
    tables = {table.name: table for table in described.tables}
    sensors: dict[str, Node] = {
        # Its columns are at hand wherever the index is a unit id.
        "additional_oids": {"data": [{"oid": [f"{MIB}::pgwDeviceName"]}]},
        "state": {"data": [*_device_states(tables["pgwDevice"]), *_conditions(tables), *_point_states(tables, maps)]},
    }
    for kind, (name, _) in _CLASSES.items():
        found = list(_totals(tables["pgwEnergy"], maps, kind))
        if found:
            sensors[name] = {"data": found}
    return {"mib": MIB, "modules": {"os": {"version": f"{MIB}::pgwVersion.0"}, "sensors": sensors}}


def _device_states(table: Table) -> Iterator[Node]:
    columns = {column.name: column for column in table.columns}
    for name, words, generic in (
        ("pgwDeviceState", "controller", _STATES_OF_A_DEVICE),
        ("pgwDeviceSeverity", "worst condition", _SEVERITIES),
    ):
        column = columns[name]
        assert column.convention is not None
        yield _state(
            table,
            column,
            f"{{{{ $pgwDeviceName }}}} {words}",
            [_named(number, label, generic[label]) for number, label in column.convention.labels],
        )


def _conditions(tables: dict[str, Table]) -> Iterator[Node]:
    table = tables["pgwCondition"]
    columns = {column.name: column for column in table.columns}
    for severity, generic in ((Severity.CRITICAL, CRITICAL), (Severity.WARNING, WARNING)):
        yield {
            **_state(
                table,
                columns["pgwConditionState"],
                "unit {{ $subindex0 }}: {{ $pgwConditionText }} ({{ $pgwConditionName }} {{ $subindex1 }})",
                [
                    _named(ConditionState.CLEAR, "clear", OK),
                    _named(ConditionState.RAISED, "raised", generic),
                    _named(ConditionState.UNKNOWN, "unknown", UNKNOWN),
                ],
            ),
            "state_name": f"pgwConditionState{severity.name.title()}",
            "group": "Conditions of unit {{ $subindex0 }}",
            "skip_values": [{"oid": "pgwConditionSeverity", "op": "!=", "value": int(severity)}],
        }


def _point_states(tables: dict[str, Table], maps: Sequence[DeviceMap]) -> Iterator[Node]:
    """What charger and load are doing: the enumerations that the maps' rules of night and load are about."""
    states: dict[str, dict[int, tuple[str, int]]] = {}
    for device_map in maps:
        rules = [rule.point for rule in (device_map.night, device_map.load) if rule is not None]
        for name in rules:
            point = device_map.point(name)
            cut_off = (
                device_map.load.disconnected if device_map.load is not None and device_map.load.point == name else ()
            )
            for value in device_map.enumerations[point.enumeration or ""]:
                broken = value.name == _BROKEN or value.number in cut_off
                states.setdefault(name, {})[value.number] = (value.name, CRITICAL if broken else OK)
    for column in tables["pgwLive"].columns:
        if column.point in states:
            yield _state(
                tables["pgwLive"],
                column,
                f"{{{{ $pgwDeviceName }}}} {_words(column.point)}",
                [_named(number, *each) for number, each in sorted(states[column.point].items())],
            )


def _totals(table: Table, maps: Sequence[DeviceMap], unit: str) -> Iterator[Node]:
    points: dict[str, Point] = {}
    for device_map in maps:
        points |= {point.name: point for point in device_map.points if point.group is Group.ENERGY}
    for column in table.columns:
        point = points[column.point or ""]
        if point.unit != unit or point.mib is None:
            continue
        yield {
            "oid": f"{table.name}Table",
            "value": column.name,
            "num_oid": _number(table, column),
            "index": f"{column.name}.{{{{ $index }}}}",
            "descr": f"{{{{ $pgwDeviceName }}}} {_words(point.name)}{_CLASSES[unit][1]}",
            "divisor": point.mib.scale,
        }


def _state(table: Table, column: ObjectType, words: str, states: list[Node]) -> dict[str, Node]:
    return {
        "oid": f"{table.name}Table",
        "value": column.name,
        "num_oid": _number(table, column),
        "index": f"{column.name}.{{{{ $index }}}}",
        "descr": words,
        "state_name": column.name,
        "states": states,
    }


def _named(number: int, words: str, generic: int) -> Node:
    return {"value": int(number), "descr": words.replace("_", " "), "graph": 1, "generic": generic}


def _number(table: Table, column: ObjectType) -> str:
    return f".{_dotted((*table.base, 1, column.number))}.{{{{ $index }}}}"


def _words(point: str) -> str:
    return point.replace("_", " ")


def _dotted(oid: Oid) -> str:
    return ".".join(map(str, oid))
