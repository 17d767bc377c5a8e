"""Modules for the Prometheus SNMP exporter: the MIB, with values by the names and in the units of `/metrics`.

Rule 1: a point has the name of its metric and is in base units. What the agent sends in thousandths is shifted by
        regular expressions, because Debian 12's exporter has no `scale` yet. Where the factor is no power of ten (hours
        to seconds) the name says the unit that it is in.
Rule 2: everything else has its name in the MIB; its units stand in the help.
Rule 3: series of a device are labelled as those of `/metrics`; `site` is the scraper's to add.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

from gateway.devices.model import DeviceMap, Point
from gateway.devices.schema import load_map, models
from gateway.devices.units import METRIC_PREFIX
from gateway.faces.snmp.layout import Layout, column_name, shipped_layout
from gateway.faces.snmp.objects import ObjectType, RowKind, ScalarGroup, Syntax, Table
from gateway.faces.snmp.settings import DEFAULT_ROOT, Oid
from gateway.generate.yaml import Node, dump

FOLDER = "deploy/nms/snmp_exporter"
MODULE = "prostar_gateway"
SETTINGS_MODULE = "prostar_gateway_settings"

_SETTINGS_TABLE = "pgwSettings"
_CONDITION_COLUMNS = ("pgwConditionName", "pgwConditionSeverity", "pgwConditionState", "pgwConditionCount")
_AS_LABELS = {"pgwDeviceName", "pgwDeviceModel", "pgwDeviceLine", "pgwLineName", "pgwConditionName"}
_CHATTER = {"pgwLineError", "pgwLineTopClient"}
"""Texts that would make a new series whenever they change."""

_SCRAPED = (RowKind.LINE, RowKind.DEVICE, RowKind.CONDITION)
"""Days of the log and the like are no series."""

_UNIT_WORDS = {"h": "hours", "d": "days"}
_HUNDREDTHS = "hundredths of a second"

_MARK = "# Made by `prostar-gateway generate` from the device maps. Do not edit.\n"
_NEW = "# For snmp_exporter 0.23 and later, such as Debian 13's; set the community or the pass phrases below.\n"
_OLD = "# For snmp_exporter 0.21 and 0.22, such as Debian 12's; set the community in both modules.\n"


def exporter_outputs(root: Oid = DEFAULT_ROOT) -> dict[str, str]:
    """The configuration files of the exporter, by path from the repository; `root` as for the MIB."""
    modules = _modules(shipped_layout(root), [load_map(model) for model in models()])
    auths: dict[str, Node] = {
        "prostar_v2c": {"community": "CHANGE-ME", "security_level": "noAuthNoPriv", "version": 2},
        "prostar_v3": {
            "username": "noc",
            "security_level": "authPriv",
            "auth_protocol": "SHA256",
            "password": "CHANGE-ME",
            "priv_protocol": "AES",
            "priv_password": "CHANGE-ME",
            "version": 3,
        },
    }
    with_auth: dict[str, Node] = {
        name: {**module, "version": 2, "auth": {"community": "CHANGE-ME"}} for name, module in modules.items()
    }
    return {
        f"{FOLDER}/snmp.yml": _MARK + _NEW + dump({"auths": auths, "modules": modules}),
        f"{FOLDER}/snmp-debian12.yml": _MARK + _OLD + dump(with_auth),
    }


def metric_of(point: Point) -> tuple[str, int | None]:
    """Name of a point's metric as scraped by SNMP, and the power of ten between it and the agent's number.

    None: it stays as the agent sends it.
    """
    assert point.mib is not None
    assert point.metric is not None
    if point.mib.syntax in {"Enumeration", "Bits", "Text"}:
        return point.metric, None
    factor = point.metric_scale / point.mib.scale
    power = round(math.log10(factor))
    if not math.isclose(factor, 10.0**power):
        return f"{METRIC_PREFIX}{point.name}_{_UNIT_WORDS[point.unit]}", None
    return point.metric, power or None


def _modules(described: Layout, maps: Sequence[DeviceMap]) -> dict[str, dict[str, Node]]:
    settings = {table.name: table for table in described.tables}[_SETTINGS_TABLE]
    tables = [table for table in described.tables if table is not settings and table.rows in _SCRAPED]
    names = _Names(described, maps)
    return {
        MODULE: _module(
            [
                *(_dotted(group.base) for group in described.groups),
                *(oid for table in tables for oid in _walked(table)),
            ],
            [
                *(metric for group in described.groups for metric in names.of_group(group)),
                *(metric for table in tables for metric in names.of_table(table)),
            ],
        ),
        SETTINGS_MODULE: _module(
            [_dotted(settings.base), *names.looked_up(RowKind.DEVICE)], list(names.of_table(settings))
        ),
    }


def _module(walk: list[str], metrics: list[Node]) -> dict[str, Node]:
    # A device's cells come 40 to a reply of 1,400 octets, however many are asked for.
    return {"walk": walk, "max_repetitions": 50, "retries": 2, "timeout": "3s", "metrics": metrics}


def _walked(table: Table) -> list[str]:
    if table.rows is not RowKind.CONDITION:
        return [_dotted(table.base)]
    return [_dotted((*table.base, 1, each.number)) for each in table.columns if each.name in _CONDITION_COLUMNS]


def _dotted(oid: Oid) -> str:
    return ".".join(map(str, oid))


class _Names:
    """What the metrics are called, and what is looked up for their labels."""

    def __init__(self, described: Layout, maps: Sequence[DeviceMap]) -> None:
        self._points: dict[str, Point] = {}
        self._labels: dict[str, dict[int, str]] = {}  # by the name of the column
        for device_map in maps:
            for point in device_map.points:
                self._points.setdefault(point.name, point)
                if point.mib is None:
                    continue
                labels = self._labels.setdefault(column_name(point), {})
                if point.enumeration is not None:
                    labels.update((each.number, each.name) for each in device_map.enumerations[point.enumeration])
                if point.bits is not None:
                    labels.update((each.number, each.name) for each in device_map.bit_tables[point.bits])
        self._oids = {
            column.name: _dotted((*table.base, 1, column.number))
            for table in described.tables
            for column in table.columns
        }

    def looked_up(self, rows: RowKind) -> list[str]:
        """The columns that the labels of such rows are looked up in."""
        return list(dict.fromkeys(str(each["oid"]) for each in self._lookups(rows) if "oid" in each))

    def of_group(self, group: ScalarGroup) -> Iterator[Node]:
        """The metrics of scalars."""
        for each in group.objects:
            yield self._metric(each, _dotted((*group.base, each.number)), {})

    def of_table(self, table: Table) -> Iterator[Node]:
        """The metrics of a table's columns."""
        index = {
            RowKind.LINE: ("line_index",),
            RowKind.CONDITION: ("unit_id", "condition_code"),
        }.get(table.rows, ("unit_id",))
        labels: dict[str, Node] = {
            "indexes": [{"labelname": name, "type": "gauge"} for name in index],
            "lookups": self._lookups(table.rows),
        }
        for each in table.columns:
            if each.name in _AS_LABELS | _CHATTER or (
                table.rows is RowKind.CONDITION and each.name not in _CONDITION_COLUMNS
            ):
                continue
            yield self._metric(each, self._oids[each.name], labels)

    def _lookups(self, rows: RowKind) -> list[dict[str, Node]]:
        if rows is RowKind.LINE:
            return [self._lookup(["line_index"], "line", "pgwLineName")]
        if rows is RowKind.CONDITION:
            return [
                self._lookup(["unit_id"], "device", "pgwDeviceName"),
                self._lookup(["unit_id", "condition_code"], "condition", "pgwConditionName"),
            ]
        return [
            self._lookup(["unit_id"], "device", "pgwDeviceName"),
            self._lookup(["unit_id"], "model", "pgwDeviceModel"),
            self._lookup(["unit_id"], "line_index", "pgwDeviceLine", "gauge"),
            self._lookup(["line_index"], "line", "pgwLineName"),
            {"labels": [], "labelname": "line_index"},
        ]

    def _lookup(self, labels: list[str], name: str, column: str, kind: str = "DisplayString") -> dict[str, Node]:
        return {"labels": labels, "labelname": name, "oid": self._oids[column], "type": kind}

    def _metric(self, each: ObjectType, oid: str, labels: Mapping[str, Node]) -> Node:
        point = self._points.get(each.point or "")
        if point is not None and point.metric is not None:
            return self._point_metric(point, each, oid, labels)
        units = _HUNDREDTHS if each.syntax in {Syntax.TIME_TICKS, Syntax.TIME_STAMP} else each.units
        node: dict[str, Node] = {
            "name": each.name,
            "oid": oid,
            "type": _KINDS[each.syntax],
            "help": f"{each.description} ({units})" if units else each.description,
            **labels,
        }
        if each.convention is not None and each.name not in _CONDITION_COLUMNS:
            node["type"] = "EnumAsStateSet"
            node["enum_values"] = {str(number): name for number, name in each.convention.labels}
        return node

    def _point_metric(self, point: Point, each: ObjectType, oid: str, labels: Mapping[str, Node]) -> Node:
        name, power = metric_of(point)
        node: dict[str, Node] = {"name": name, "oid": oid, "type": "gauge", "help": point.help, **labels}
        if each.syntax is Syntax.ENUMERATION or each.syntax is Syntax.BITS:
            node["type"] = "EnumAsStateSet" if each.syntax is Syntax.ENUMERATION else "Bits"
            node["enum_values"] = {str(number): text for number, text in sorted(self._labels[each.name].items())}
        elif each.syntax is Syntax.TEXT:
            node["type"] = "DisplayString"
        elif power is not None:
            # The exporter puts the name of an extract behind that of the metric.
            begin, _, end = name.rpartition("_")
            node |= {"name": begin, "type": "DisplayString", "regex_extracts": {f"_{end}": _shifted(power)}}
        elif point.metric_type == "counter":
            node["type"] = "counter"
        return node


_KINDS = {
    Syntax.INTEGER32: "gauge",
    Syntax.UNSIGNED32: "gauge",
    Syntax.GAUGE32: "gauge",
    Syntax.COUNTER32: "counter",
    Syntax.TIME_TICKS: "gauge",
    Syntax.TIME_STAMP: "gauge",
    Syntax.TEXT: "DisplayString",
    Syntax.ENUMERATION: "gauge",
    Syntax.BITS: "Bits",
    Syntax.OBJECT_IDENTIFIER: "DisplayString",
}


def _shifted(power: int) -> list[Node]:
    """A whole number times 10^power, as text: what is tried in turn until one fits."""
    if power > 0:
        return [{"regex": r"(-?\d+)", "value": "${1}" + "0" * power}]
    places = -power
    short: list[Node] = [
        {"regex": rf"(-?)(\d{{{digits}}})", "value": "${1}0." + "0" * (places - digits) + "${2}"}
        for digits in range(1, places)
    ]
    return [*short, {"regex": rf"(-?\d*)(\d{{{places}}})", "value": "${1}.${2}"}]
