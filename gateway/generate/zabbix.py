"""A Zabbix template: controllers, lines and conditions by low-level discovery, values by numbers alone, no MIB needed.

Rule 1: a controller's values are prototypes of a rule of its model, so no item asks for what a model does not have.
Rule 2: a value that is not there (the controller is away, no sensor is fitted) is left out, not an error of the item.
Rule 3: alarms come from the condition table, which has a row for each fault and alarm of the maps and for what the
        gateway sees itself; a rule for each severity, since a trigger's severity is fixed.
Rule 4: uuids follow from names, so a template that is imported again changes what it was.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence

from gateway.core.conditions import ConditionState, Severity
from gateway.devices.model import DeviceMap, Group, Point
from gateway.devices.schema import load_map, models
from gateway.faces.snmp.layout import Layout, column_name, shipped_layout
from gateway.faces.snmp.objects import Convention, ObjectType, Syntax, Table
from gateway.faces.snmp.settings import DEFAULT_ROOT, Oid
from gateway.faces.snmp.standard import SYSTEM
from gateway.generate.rules import BATTERY_LIMITS, HIGHEST_VOLTS
from gateway.generate.yaml import Node, dump
from gateway.generate.zabbix_parts import (
    IF_THERE,
    SPLIT_INDEX,
    TEMPLATE,
    bits_script,
    item,
    multiplier,
    only,
    rule,
    step,
    tags,
    trigger,
    uuid_of,
)

PATH = "deploy/nms/zabbix/prostar-gateway.yaml"
GROUP = "Templates/Power"
VERSION = "6.0"

UNITS = {"V": "V", "A": "A", "W": "W", "°C": "°C", "Ah": "Ah", "kWh": "Wh", "h": "s", "s": "s", "d": "s", "Ω": "Ω"}
"""Zabbix' units; it writes 12340 Wh as 12.34 KWh and 3600 s as 1h by itself."""

_DELAYS = {Group.LIVE: "1m", Group.ENERGY: "5m", Group.TODAY: "5m", Group.SETTINGS: "1h"}
_BATTERY = "battery_voltage_slow_60s"
_MULTIPLIER = "settings_voltage_multiplier"
_HIGHEST = "battery_voltage_maximum"
_ALSO = frozenset({_MULTIPLIER, "software_version"})
"""Settings that are of use here; the others hardly change."""

_PRIORITIES = {Severity.CRITICAL: "HIGH", Severity.WARNING: "WARNING", Severity.INFO: "INFO"}
_BATTERY_PRIORITIES = {"critical": "HIGH", "warning": "WARNING"}

_ABOUT = (
    "Solar charge controllers behind prostar-gateway, by SNMPv2c or SNMPv3. The interface's credentials are those of"
    " the gateway; macros hold the battery's limits for each 12 V."
)
_MARK = "# Made by `prostar-gateway generate` from the device maps. Do not edit.\n"


def zabbix_outputs(root: Oid = DEFAULT_ROOT) -> dict[str, str]:
    """The template by path from the repository; `root` as for the MIB."""
    maker = _Template(shipped_layout(root), [load_map(model) for model in models()])
    export: dict[str, Node] = {
        "version": VERSION,
        "groups": [{"uuid": uuid_of("group", GROUP), "name": GROUP}],
        "templates": [maker.template()],
    }
    return {PATH: _MARK + dump({"zabbix_export": export})}


class _Template:
    def __init__(self, described: Layout, maps: Sequence[DeviceMap]) -> None:
        self._maps = maps
        self._tables = {table.name: table for table in described.tables}
        self._groups = {group.name: group for group in described.groups}
        self._conventions = {each.name: each for each in described.conventions}
        self._used: dict[str, Convention] = {}

    def template(self) -> Node:
        """The whole of it."""
        items = list(self._items())
        rules = [self._controllers(), *map(self._values, self._maps), self._lines(), *self._conditions()]
        return {
            "uuid": uuid_of("template"),
            "template": TEMPLATE,
            "name": TEMPLATE,
            "description": _ABOUT,
            "groups": [{"name": GROUP}],
            "items": items,
            "discovery_rules": rules,
            "macros": [
                {"macro": f"{{$BATTERY.{name.upper()}.{which}}}", "value": f"{limit:g}", "description": words}
                for name, limits in BATTERY_LIMITS.items()
                for which, limit, words in (
                    ("BELOW", limits[0], "Volts of each 12 V below which the battery is low (lead-acid)."),
                    ("ENDS", limits[1], "Volts of each 12 V above which it is not any more."),
                )
            ],
            "valuemaps": [
                {
                    "uuid": uuid_of("valuemap", name),
                    "name": name,
                    "mappings": [{"value": str(number), "newvalue": label} for number, label in convention.labels],
                }
                for name, convention in sorted(self._used.items())
            ],
        }

    def _items(self) -> Iterator[Node]:
        """The gateway itself."""
        yield {
            "uuid": uuid_of("item", "available"),
            "name": "SNMP availability",
            "type": "INTERNAL",
            "key": "zabbix[host,snmp,available]",
            "triggers": [
                trigger(
                    "SNMP of the gateway does not answer",
                    f"max(/{TEMPLATE}/zabbix[host,snmp,available],5m)=0",
                    "HIGH",
                )
            ],
        }
        uptime = item("item", "Uptime", "prostar.uptime", (*SYSTEM, 3, 0), units="uptime")
        yield {
            **uptime,
            "preprocessing": [step("MULTIPLIER", "0.01")],
            "triggers": [
                {
                    **trigger("The gateway was restarted", f"last(/{TEMPLATE}/prostar.uptime)<10m", "INFO"),
                    "manual_close": "YES",
                }
            ],
        }
        for name in ("pgwGateway", "pgwModbus"):
            group = self._groups[name]
            for each in group.objects:
                if each.syntax is not Syntax.TIME_TICKS:
                    yield self._plain("item", each, (*group.base, each.number, 0), _words(each.name), "")

    def _controllers(self) -> Node:
        """What the gateway knows of every controller."""
        table = self._tables["pgwDevice"]
        wanted = (
            "pgwDeviceState",
            "pgwDeviceSeverity",
            "pgwDeviceConditions",
            "pgwDeviceReplyAge",
            "pgwDeviceDataAge",
            "pgwDeviceRefresh",
            "pgwDeviceProduct",
            "pgwDeviceRevision",
            "pgwDeviceSerialNumber",
            "pgwDeviceTimeouts",
            "pgwDeviceCrcErrors",
        )
        return {
            **rule("Controllers", "prostar.controllers", {"{#NAME}": (table, "pgwDeviceName")}),
            "item_prototypes": self._prototypes(table, wanted, "{#NAME}: "),
        }

    def _lines(self) -> Node:
        table = self._tables["pgwLine"]
        wanted = ("pgwLineState", "pgwLineError", "pgwLineUse", "pgwLineQueue", "pgwLineRequests", "pgwLineFailures")
        return {
            **rule("Lines", "prostar.lines", {"{#NAME}": (table, "pgwLineName")}),
            "item_prototypes": self._prototypes(table, wanted, "Line {#NAME}: "),
        }

    def _prototypes(self, table: Table, wanted: Sequence[str], begin: str) -> list[Node]:
        columns = {column.name: column for column in table.columns}
        return [
            self._plain("prototype", columns[name], (*table.base, 1, columns[name].number), _words(name), begin)
            for name in wanted
        ]

    def _conditions(self) -> Iterator[Node]:
        """One rule a severity."""
        table = self._tables["pgwCondition"]
        columns = {column.name: column for column in table.columns}
        state = columns["pgwConditionState"]
        for severity, priority in _PRIORITIES.items():
            key = f"prostar.condition.{severity.name.lower()}[{{#SNMPINDEX}}]"
            macros = {
                "{#CONDITION}": (table, "pgwConditionName"),
                "{#TEXT}": (table, "pgwConditionText"),
                "{#SEVERITY}": (table, "pgwConditionSeverity"),
            }
            alarm = trigger(
                "Unit {#UNIT}: {#TEXT} ({#CONDITION})", f"last(/{TEMPLATE}/{key})={ConditionState.RAISED:d}", priority
            )
            node = item("prototype", "Unit {#UNIT}: {#CONDITION} {#CODE}", key, (*table.base, 1, state.number))
            yield {
                **rule(f"Conditions: {severity.name.lower()}", f"prostar.conditions.{severity.name.lower()}", macros),
                "filter": only("{#SEVERITY}", str(int(severity))),
                "preprocessing": [step("JAVASCRIPT", SPLIT_INDEX)],
                "item_prototypes": [{**node, **self._mapped(state.convention), "trigger_prototypes": [alarm]}],
            }

    def _values(self, device_map: DeviceMap) -> Node:
        """Everything that is measured by, and the state of, controllers of one model."""
        table = self._tables["pgwDevice"]
        macros = {"{#NAME}": (table, "pgwDeviceName"), "{#MODEL}": (table, "pgwDeviceModel")}
        columns = {
            column.name: (holder, column)
            for holder in self._tables.values()
            for column in holder.columns
            if column.point
        }
        prototypes = [
            self._point(device_map, point, *columns[column_name(point)])
            for point in device_map.points
            if point.mib is not None
            and ((point.group in _DELAYS and point.group is not Group.SETTINGS) or point.name in _ALSO)
        ]
        node: dict[str, Node] = {
            **rule(device_map.title, f"prostar.{device_map.model}", macros),
            "filter": only("{#MODEL}", device_map.model),
            "item_prototypes": prototypes,
        }
        names = {point.name for point in device_map.points}
        if _BATTERY in names and (factor := _times_12_v(device_map.model, names)):
            node["trigger_prototypes"] = list(self._battery(device_map.model, factor))
        return node

    def _battery(self, model: str, factor: str) -> Iterator[Node]:
        voltage = f"/{TEMPLATE}/{_key(model, _BATTERY)}"
        for name, (_, _, severity, _) in BATTERY_LIMITS.items():
            words = {"Low": "low", "VeryLow": "very low"}[name]
            yield {
                **trigger(
                    f"{{#NAME}}: battery {words}",
                    f"max({voltage},5m)<{{$BATTERY.{name.upper()}.BELOW}}*{factor}",
                    _BATTERY_PRIORITIES[severity],
                ),
                "recovery_mode": "RECOVERY_EXPRESSION",
                "recovery_expression": f"min({voltage},5m)>{{$BATTERY.{name.upper()}.ENDS}}*{factor}",
            }

    def _point(self, device_map: DeviceMap, point: Point, table: Table, column: ObjectType) -> Node:
        assert point.mib is not None
        node = item(
            "prototype",
            f"{{#NAME}}: {point.name.replace('_', ' ')}",
            _key(device_map.model, point.name),
            (*table.base, 1, column.number),
            delay=_DELAYS[point.group],
            description=point.help,
        )
        steps: list[Node] = [IF_THERE]
        if column.syntax is Syntax.BITS:
            names = {bit.number: bit.name for bit in device_map.bit_tables[point.bits or ""]}
            steps += [
                step("JAVASCRIPT", bits_script(names, 2 * point.words)),
                step("DISCARD_UNCHANGED_HEARTBEAT", "1h"),
            ]
            node |= {"value_type": "TEXT", "trends": "0"}
        elif column.syntax is Syntax.ENUMERATION:
            steps.append(step("DISCARD_UNCHANGED_HEARTBEAT", "10m"))
            node |= self._mapped(column.convention)
        else:
            node |= {"value_type": "FLOAT", "units": UNITS.get(point.unit, "")}
            if (factor := multiplier(point)) != "1":
                steps.append(step("MULTIPLIER", factor))
        return {**node, "preprocessing": steps, "tags": tags(point.group.value)}

    def _plain(self, kind: str, each: ObjectType, oid: Oid, words: str, begin: str) -> Node:
        """An item of an object that is no point."""
        key = f"prostar.{each.name.removeprefix('pgw').lower()}" + ("[{#SNMPINDEX}]" if kind == "prototype" else "")
        node = item(kind, begin + words, key, oid, description=each.description)
        steps: list[Node] = [IF_THERE] if kind == "prototype" else []
        if each.syntax is Syntax.TEXT:
            node |= {"value_type": "CHAR", "trends": "0", "delay": "15m"}
            steps.append(step("DISCARD_UNCHANGED_HEARTBEAT", "1d"))
        elif each.syntax is Syntax.ENUMERATION:
            node |= self._mapped(each.convention)
        elif each.syntax is Syntax.COUNTER32:
            node |= {"value_type": "FLOAT", "units": "/s"}
            steps.append(step("CHANGE_PER_SECOND"))
        else:
            scaled = {"milliseconds": ("s", "0.001"), "0.1 percent": ("%", "0.1")}.get(each.units)
            if each.syntax in {Syntax.TIME_TICKS, Syntax.TIME_STAMP}:
                scaled = ("s", "0.01")
            if scaled is not None:
                node |= {"value_type": "FLOAT", "units": scaled[0]}
                steps.append(step("MULTIPLIER", scaled[1]))
        return {**node, **({"preprocessing": steps} if steps else {})}

    def _mapped(self, convention: Convention | None) -> dict[str, Node]:
        assert convention is not None
        self._used[convention.name] = convention
        return {"valuemap": {"name": convention.name}}


def _times_12_v(model: str, names: Collection[str]) -> str:
    """How many times 12 V the battery of a controller has, as an expression; "" where nothing tells."""
    if _MULTIPLIER in names:
        return f"last(/{TEMPLATE}/{_key(model, _MULTIPLIER)})"
    if _HIGHEST in names:
        highest = f"last(/{TEMPLATE}/{_key(model, _HIGHEST)})"
        return f"(1+({highest}>={HIGHEST_VOLTS[12]})+2*({highest}>={HIGHEST_VOLTS[24]}))"
    return ""


def _key(model: str, point: str) -> str:
    return f"morningstar.{point}[{model},{{#SNMPINDEX}}]"


def _words(name: str) -> str:
    """`pgwDeviceReplyAge` as `device reply age`."""
    return "".join(f" {letter.lower()}" if letter.isupper() else letter for letter in name.removeprefix("pgw")).strip()
