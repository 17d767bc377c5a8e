"""A Telegraf configuration: every value of a controller in one measurement, by numbers alone, so that it needs no MIB.

Fields are `<point>_<unit>`; `float(3)` is Telegraf's way to say that the agent sends thousandths.
"""

from __future__ import annotations

from collections.abc import Iterator

from gateway.devices.model import Point
from gateway.devices.schema import load_map, models
from gateway.faces.snmp.layout import shipped_layout
from gateway.faces.snmp.objects import ObjectType, Syntax, Table
from gateway.faces.snmp.settings import DEFAULT_ROOT, Oid

PATH = "deploy/nms/telegraf/prostar-gateway.conf"

TABLES = ("pgwLive", "pgwEnergy", "pgwToday")
"""Their cells are the fields; settings hardly change."""

UNITS = {
    "V": "volts",
    "A": "amperes",
    "W": "watts",
    "°C": "celsius",
    "Ah": "amperehours",
    "kWh": "kilowatthours",
    "h": "hours",
    "s": "seconds",
    "d": "days",
    "Ω": "ohms",
    "ratio": "ratio",
}

_HEAD = """\
# Made by `prostar-gateway generate` from the device maps. Do not edit.
# A field is missing while its controller is not online; `state`, which is 2 while it is, is always there.

[[inputs.snmp]]
  agents = ["udp://127.0.0.1:1161"]
  interval = "15s"
  timeout = "3s"
  retries = 2
  name = "prostar_gateway"
  version = 2
  community = "CHANGE-ME"
  # Better, over a network: SNMPv3.
  # version = 3
  # sec_name = "noc"
  # sec_level = "authPriv"
  # auth_protocol = "SHA256"
  # auth_password = "CHANGE-ME"
  # priv_protocol = "AES"
  # priv_password = "CHANGE-ME"
"""


def telegraf_outputs(root: Oid = DEFAULT_ROOT) -> dict[str, str]:
    """The configuration by path from the repository; `root` as for the MIB."""
    described = shipped_layout(root)
    tables = {table.name: table for table in described.tables}
    gateway = next(group for group in described.groups if group.name == "pgwGateway")
    scalars = {each.name: (*gateway.base, each.number, 0) for each in gateway.objects}
    points: dict[str, Point] = {}
    for model in models():
        points = {point.name: point for point in load_map(model).points} | points
    lines = [
        *_field("inputs.snmp.field", "site", scalars["pgwSiteName"], tag=True),
        *_field("inputs.snmp.field", "devices_online", scalars["pgwDevicesOnline"]),
        *_field("inputs.snmp.field", "lines_open", scalars["pgwLinesOpen"]),
        *_field("inputs.snmp.field", "conditions_active", scalars["pgwConditionsActive"]),
        *_table("prostar_controller", "One row a controller; `index` is its unit id."),
        *_columns(tables["pgwDevice"], {"pgwDeviceName": "device", "pgwDeviceModel": "model"}, tag=True),
        *_columns(
            tables["pgwDevice"],
            {"pgwDeviceState": "state", "pgwDeviceReplyAge": "reply_age_s", "pgwDeviceSeverity": "severity"},
        ),
        *(line for name in TABLES for line in _points(tables[name], points)),
        *_table(
            "prostar_condition", "One row for all that can be wrong; `index` is unit id and code, state 2 is raised."
        ),
        *_columns(tables["pgwCondition"], {"pgwConditionName": "condition"}, tag=True),
        *_columns(tables["pgwCondition"], {"pgwConditionState": "state", "pgwConditionSeverity": "severity"}),
    ]
    return {PATH: _HEAD + "\n".join(lines) + "\n"}


def field_name(point: Point) -> str:
    """What a point is called."""
    return f"{point.name}_{UNITS[point.unit]}" if point.unit in UNITS else point.name


def _points(table: Table, points: dict[str, Point]) -> Iterator[str]:
    for column in table.columns:
        point = points[column.point or ""]
        if column.syntax is Syntax.BITS:
            continue  # they are the conditions
        assert point.mib is not None
        places = len(str(point.mib.scale)) - 1
        yield from _cell(table, column, field_name(point), places=places)


def _columns(table: Table, names: dict[str, str], *, tag: bool = False) -> Iterator[str]:
    for column in table.columns:
        if column.name in names:
            places = 2 if column.syntax is Syntax.TIME_TICKS else 0
            yield from _cell(table, column, names[column.name], places=places, tag=tag)


def _cell(table: Table, column: ObjectType, name: str, *, places: int = 0, tag: bool = False) -> list[str]:
    return _field("inputs.snmp.table.field", name, (*table.base, 1, column.number), places=places, tag=tag)


def _table(name: str, about: str) -> list[str]:
    return [
        "",
        f"  # {about}",
        "  [[inputs.snmp.table]]",
        f'    name = "{name}"',
        '    inherit_tags = ["site"]',
        "    index_as_tag = true",
    ]


def _field(kind: str, name: str, oid: Oid, *, places: int = 0, tag: bool = False) -> list[str]:
    indent = "  " * (kind.count(".") - 1)
    lines = ["", f"{indent}[[{kind}]]", f'{indent}  name = "{name}"', f'{indent}  oid = "{".".join(map(str, oid))}"']
    if tag:
        lines.append(f"{indent}  is_tag = true")
    if places:
        lines.append(f'{indent}  conversion = "float({places})"')
    return lines
