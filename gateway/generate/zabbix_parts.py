"""The pieces of a Zabbix export: uuids, items, rules, triggers and preprocessing steps as Zabbix 6.0 writes them."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping

from gateway.devices.model import Point
from gateway.faces.snmp.objects import Table
from gateway.faces.snmp.settings import Oid
from gateway.generate.yaml import Node

TEMPLATE = "ProStar gateway by SNMP"

SPLIT_INDEX = """\
return JSON.stringify(JSON.parse(value).map(function (row) {
    var parts = row['{#SNMPINDEX}'].split('.');
    row['{#UNIT}'] = parts[0];
    row['{#CODE}'] = parts[1];
    return row;
}));"""
"""JavaScript that gives each row of a discovery by unit id and code these two as macros."""

IF_THERE: Node = {"type": "CHECK_NOT_SUPPORTED", "parameters": [""], "error_handler": "DISCARD_VALUE"}
"""A value that is not there now is no error of the item."""


def uuid_of(*names: str) -> str:
    """A version 4 UUID in Zabbix' form, always the same for the same names."""
    digits = hashlib.sha256("/".join((TEMPLATE, *names)).encode()).hexdigest()[:32]
    variant = "89ab"[int(digits[16], 16) % 4]
    return f"{digits[:12]}4{digits[13:16]}{variant}{digits[17:]}"


def bits_script(names: Mapping[int, str], octets: int) -> str:
    """JavaScript that turns an octet string as Zabbix shows it into the names of the bits that are set."""
    return f"""\
var names = {json.dumps({str(number): name for number, name in sorted(names.items())})};
var octets = [], set = [];
if (new RegExp('^([0-9A-Fa-f]{{2}}[ \\\\n]*){{{octets}}}$').test(value)) {{
    octets = value.match(/[0-9A-Fa-f]{{2}}/g).map(function (pair) {{ return parseInt(pair, 16); }});
}} else {{
    for (var at = 0; at < value.length; at++) {{
        octets.push(value.charCodeAt(at));
    }}
}}
for (var bit = 0; bit < 8 * octets.length; bit++) {{
    if (octets[bit >> 3] & (128 >> (bit & 7))) {{
        set.push(names[bit] || 'bit_' + bit);
    }}
}}
return set.length ? set.join(', ') : 'none';"""


def multiplier(point: Point) -> str:
    """What the agent's number is multiplied by, for base units; "1" for nothing."""
    assert point.mib is not None
    return f"{point.metric_scale / point.mib.scale:.10g}"


def item(
    kind: str, name: str, key: str, oid: Oid, *, delay: str = "1m", units: str = "", description: str = ""
) -> dict[str, Node]:
    """An item of `kind` "item" or "prototype"; a prototype asks for the discovered index of the column `oid`."""
    node: dict[str, Node] = {
        "uuid": uuid_of(kind, key),
        "name": name,
        "type": "SNMP_AGENT",
        "snmp_oid": ".".join(map(str, oid)) + (".{#SNMPINDEX}" if kind == "prototype" else ""),
        "key": key,
        "delay": delay,
    }
    return {**node, **({"units": units} if units else {}), **({"description": description} if description else {})}


def rule(name: str, key: str, macros: Mapping[str, tuple[Table, str]]) -> dict[str, Node]:
    """A discovery rule: macro → the column that it is filled from."""
    parts: list[str] = []
    for macro, (table, column_name) in macros.items():
        number = next(column.number for column in table.columns if column.name == column_name)
        parts += [macro, ".".join(map(str, (*table.base, 1, number)))]
    return {
        "uuid": uuid_of("rule", key),
        "name": name,
        "type": "SNMP_AGENT",
        "snmp_oid": f"discovery[{','.join(parts)}]",
        "key": key,
        "delay": "1h",
    }


def trigger(name: str, expression: str, priority: str) -> dict[str, Node]:
    """A trigger, or a prototype of one."""
    return {
        "uuid": uuid_of("trigger", expression),
        "expression": expression,
        "name": name,
        "priority": priority,
    }


def step(kind: str, *parameters: str) -> Node:
    """A preprocessing step."""
    return {"type": kind, "parameters": list(parameters) or [""]}


def only(macro: str, value: str) -> Node:
    """A filter of a rule: only rows whose macro has this value."""
    return {"evaltype": "AND", "conditions": [{"macro": macro, "value": f"^{value}$", "formulaid": "A"}]}


def tags(component: str) -> list[Node]:
    """The tags of an item."""
    return [{"tag": "component", "value": component}]
