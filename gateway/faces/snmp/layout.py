"""The one description of the MIB: module structure, groups and tables, derived from the device maps.

```
root                     PROSTAR-GATEWAY-REG-MIB, the one configurable OID
 ├ 1 modules             1 PROSTAR-GATEWAY-TC-MIB   2 PROSTAR-GATEWAY-MIB
 │      2.0 notifications
      2.1 objects      1 gateway 2 line 3 device 4 live 5 energy 6 today 7 settings 8 condition 9 Modbus server
                       10 what only notifications carry 11 Modbus client 100 log, which is the last
 │      2.2 conformance  1 groups 2 compliances
 └ 2 products            1 this gateway (sysObjectID)
```

The agent and the MIB generator both read it (docs/adr/0001), so it imports no SNMP library.

A point of a map becomes a column of its group's table by the number in the map. Points of one name share a column
over all models; a disagreement about number, syntax, scale, units or labels is a `MapError`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from gateway.devices.agreement import all_maps
from gateway.devices.model import Bit, DeviceMap, EnumValue, Group, Point, Value
from gateway.errors import MapError
from gateway.faces.snmp import client_table, condition_tables, log_columns, notifications, tables
from gateway.faces.snmp.encodings import Encodings, of_bits, of_numbers
from gateway.faces.snmp.objects import (
    CellValue,
    Changes,
    Convention,
    DeviceRow,
    ObjectType,
    RowKind,
    ScalarGroup,
    Syntax,
    Table,
    text,
)
from gateway.faces.snmp.settings import DEFAULT_ROOT, Oid

PREFIX = "pgw"
NAME_LIMIT = 32
"""RFC 4181 §3.1: descriptors should not be longer."""

SHORT_WORDS: Mapping[str, str] = {
    "absorption": "abs",
    "compensation": "comp",
    "compensated": "comp",
    "equalization": "eq",
    "equalize": "eq",
    "extension": "ext",
    "maximum": "max",
    "minimum": "min",
    "percent": "pct",
    "reconnect": "reconn",
    "disconnect": "disc",
    "reference": "ref",
    "regulation": "reg",
    "resettable": "reset",
    "temperature": "temp",
    "threshold": "limit",
    "voltage": "volt",
}
"""Shorter words for names that would pass NAME_LIMIT, as few of them as it takes, the last word first; only appended
to, since names are for ever.
"""

_POINT_TABLES: tuple[tuple[int, str, Group, str], ...] = (
    (4, "pgwLive", Group.LIVE, "Live values of each device. A cell is instantiated only while the device is online."),
    (5, "pgwEnergy", Group.ENERGY, "Energy and charge totals of each device, as counted by the device."),
    (6, "pgwToday", Group.TODAY, "Values of the current day of each device, as kept by the device."),
    (7, "pgwSettings", Group.SETTINGS, "Settings of each device, read now and then (see pgwDeviceSettingsAge)."),
)


@dataclass(frozen=True, slots=True)
class Layout:
    """The private part of the MIB under one root."""

    root: Oid
    groups: tuple[ScalarGroup, ...]
    tables: tuple[Table, ...]
    conventions: tuple[Convention, ...]  # by name
    notify: ScalarGroup  # objects that only notifications carry: described, never served

    @property
    def modules(self) -> Oid:
        """Parent of the identities of the other modules."""
        return (*self.root, 1)

    @property
    def module(self) -> Oid:
        """Identity of PROSTAR-GATEWAY-MIB."""
        return (*self.modules, 2)

    @property
    def notifications(self) -> Oid:
        """Parent of the notifications (RFC 2578 §8.5: its last arc is 0)."""
        return (*self.module, 0)

    @property
    def objects(self) -> Oid:
        """Parent of all groups and tables."""
        return (*self.module, 1)

    @property
    def product(self) -> Oid:
        """What sysObjectID says."""
        return (*self.root, 2, 1)


def layout(maps: Iterable[DeviceMap], root: Oid = DEFAULT_ROOT) -> Layout:
    """Describe the MIB of all `maps` under `root`; MapError when two maps disagree about a column."""
    objects: Oid = (*root, 1, 2, 1)
    groups = (
        ScalarGroup(
            (*objects, 1), 1, "pgwGateway", "The gateway itself.", (*tables.GATEWAY, *condition_tables.GATEWAY)
        ),
        ScalarGroup((*objects, 9), 9, "pgwModbus", "The Modbus TCP server since the start.", tables.MODBUS),
    )
    by_model = sorted(maps, key=lambda device_map: device_map.model)
    columns = _Columns(by_model)
    fixed = (
        Table(
            (*objects, 2),
            2,
            "pgwLine",
            "The serial lines of the gateway, by their position in its configuration.",
            RowKind.LINE,
            "pgwLineIndex",
            tables.LINE,
        ),
        Table(
            (*objects, 3),
            3,
            "pgwDevice",
            "The devices of the gateway, by unit id. Every row always answers, whatever the device does.",
            RowKind.DEVICE,
            "pgwDeviceUnitId",
            (*tables.DEVICE, *condition_tables.DEVICE, *tables.DEVICE_SITE),
        ),
        Table(
            (*objects, 8),
            8,
            "pgwCondition",
            "Everything that can be wrong with a device, a line or the gateway. Every row is always there.",
            RowKind.CONDITION,
            "pgwConditionUnitId",
            condition_tables.CONDITION,
            indexes=condition_tables.INDEXES,
        ),
    )
    of_points = tuple(
        Table(
            (*objects, number),
            number,
            name,
            description,
            RowKind.DEVICE,
            "pgwDeviceUnitId",
            columns.of(group),
            index_of="pgwDevice",
        )
        for number, name, group, description in _POINT_TABLES
    )
    last = (
        Table(
            (*objects, 11),
            11,
            "pgwClient",
            "The Modbus TCP clients that asked last.",
            RowKind.CLIENT,
            "pgwClientIndex",
            client_table.CLIENT,
            indexes=(client_table.INDEX,),
        ),
        Table(
            (*objects, 100),
            100,
            "pgwLog",
            "The newest 256 days of each device's daily log, from the history. Always the last table; an agent may be "
            "configured to leave it out.",
            RowKind.LOG,
            "pgwDeviceUnitId",
            log_columns.log_columns(by_model, object_name, columns.convention),
            index_of="pgwDevice",
            indexes=(log_columns.INDEX,),
        ),
    )
    notify = ScalarGroup((*objects, 10), 10, "pgwNotify", "What only notifications carry.", notifications.NOTIFY)
    described = [each for group in (*groups, notify) for each in group.objects]
    described += [column for table in (*fixed, *of_points, *last) for column in table.columns]
    in_use = {each.convention.name: each.convention for each in described if each.convention is not None}
    conventions = tuple(in_use[name] for name in sorted(in_use))
    return Layout(
        root, groups, tuple(table for table in (*fixed, *of_points, *last) if table.columns), conventions, notify
    )


def shipped_layout(root: Oid = DEFAULT_ROOT) -> Layout:
    """The MIB of every model that the gateway knows, under `root`."""
    return layout(all_maps(), root)


def camel(words: str) -> str:
    """`battery_voltage` as `BatteryVoltage`."""
    return "".join(word[:1].upper() + word[1:] for word in words.split("_"))


def object_name(point: str) -> str:
    """Descriptor of a point's column; MapError when even with short words it is too long."""
    words = point.split("_")
    name = PREFIX + camel(point)
    for at in reversed(range(len(words))):
        if len(name) <= NAME_LIMIT:
            break
        words[at] = SHORT_WORDS.get(words[at], words[at])
        name = PREFIX + camel("_".join(words))
    if len(name) > NAME_LIMIT:
        raise MapError(f"point {point}: {name} is longer than {NAME_LIMIT} letters; allowed: a shorter point name")
    return name


def column_name(point: Point) -> str:
    """Descriptor of the column that a point with a MIB entry has: its own name's, or that of what the map calls it."""
    named = None if point.mib is None else point.mib.named
    return object_name(named or point.name)


def label(name: str) -> str:
    """`night_check` as the SMIv2 label `nightCheck`; MapError when it cannot be one."""
    words = camel(name)
    text = words[:1].lower() + words[1:]
    if not re.fullmatch(r"[a-z][A-Za-z0-9]*", text):
        raise MapError(f"{name!r} is no SMIv2 label: allowed are letters and digits, a letter first")
    return text


class _Columns:
    """Columns of the point tables over all models."""

    def __init__(self, maps: Sequence[DeviceMap]) -> None:
        self._conventions = _conventions(maps)
        self._columns: dict[tuple[Group, int], ObjectType] = {}
        self._numbers: dict[str, tuple[Group, int]] = {}  # by what the object is called after
        self._scales: dict[str, int] = {}
        for device_map in maps:
            for point in device_map.points:
                if point.mib is not None:
                    self._add(device_map, point)

    def of(self, group: Group) -> tuple[ObjectType, ...]:
        """Columns of one table, by number."""
        return tuple(self._columns[key] for key in sorted(self._columns) if key[0] is group)

    def _add(self, device_map: DeviceMap, point: Point) -> None:
        assert point.mib is not None
        key = (point.group, point.mib.column)
        where = f"{device_map.model}: point {point.name}"
        if point.mib.column < 2:
            raise MapError(f"{where}: column {point.mib.column}; allowed: 2 and above (1 is the index)")
        if self._numbers.setdefault(point.mib.named or point.name, key) != key:
            raise MapError(f"{where}: another model has it in another table or column")
        if self._scales.setdefault(point.name, point.mib.scale) != point.mib.scale:
            raise MapError(f"{where}: another model has it with another scale")
        column = self._column(device_map, point, where)
        known = self._columns.get(key)
        if known is None:
            self._columns[key] = column
            return
        for field in ("name", "syntax", "units", "convention"):
            if getattr(known, field) != getattr(column, field):
                raise MapError(f"{where}: column {point.mib.column} of {point.group} already has another {field}")
        assert known.models is not None
        self._columns[key] = replace(known, models=known.models | {device_map.model})

    def _column(self, device_map: DeviceMap, point: Point, where: str) -> ObjectType:
        assert point.mib is not None
        try:
            syntax = Syntax.TEXT if point.mib.syntax == "Text" else Syntax(point.mib.syntax)
        except ValueError:
            raise MapError(f"{where}: syntax {point.mib.syntax!r} is not known") from None
        convention = None
        encodings: Encodings | None
        if syntax is Syntax.BITS:
            convention = self.convention(point.bits, where)
            encodings = of_bits(point.words)
        elif syntax is Syntax.ENUMERATION:
            convention = self.convention(point.enumeration, where)
            encodings = of_numbers(syntax, 1)
        elif syntax is Syntax.TEXT:
            encodings = None
        elif syntax in {Syntax.INTEGER32, Syntax.UNSIGNED32}:
            encodings = of_numbers(syntax, point.mib.scale)
        else:
            raise MapError(f"{where}: syntax {syntax} is not for points")
        return ObjectType(
            point.mib.column,
            column_name(point),
            syntax,
            point.help,
            _text_getter(point.name) if encodings is None else _number_getter(point.name, encodings.cell),
            units=point.mib.units,
            convention=convention,
            changes=Changes.WITH_SNAPSHOT,
            models=frozenset({device_map.model}),
            point=point.name,
            encodings=encodings,
        )

    def convention(self, key: str | None, where: str) -> Convention:
        """The convention of an enumeration or a bit table, for the point or field that is said in words."""
        if key is None or key not in self._conventions:
            raise MapError(f"{where}: its syntax needs an enumeration or a bit table")
        return self._conventions[key]


def _conventions(maps: Sequence[DeviceMap]) -> dict[str, Convention]:
    """The enumerations and bit tables of all maps; a number means the same in all of them."""
    labels: dict[str, dict[int, tuple[str, str]]] = {}
    syntaxes: dict[str, Syntax] = {}
    for device_map in maps:
        tables_of_map: list[tuple[str, Syntax, Sequence[EnumValue | Bit]]] = [
            *((key, Syntax.ENUMERATION, values) for key, values in device_map.enumerations.items()),
            *((key, Syntax.BITS, bits) for key, bits in device_map.bit_tables.items()),
        ]
        for key, syntax, values in tables_of_map:
            if syntaxes.setdefault(key, syntax) is not syntax:
                raise MapError(f"{device_map.model}: {key} is both an enumeration and a bit table")
            known = labels.setdefault(key, {})
            for value in values:
                name = label(value.name)
                if known.setdefault(value.number, (name, value.text))[0] != name:
                    raise MapError(f"{device_map.model}: {key} {value.number} has another name in another model")
            if len({name for name, _ in known.values()}) != len(known):
                raise MapError(f"{device_map.model}: a label of {key} stands for two numbers")
    return {
        key: Convention(
            # A suffix, because a type and an object may not differ in the case of one letter only.
            "Pgw" + camel(key) + ("Code" if syntaxes[key] is Syntax.ENUMERATION else "Bits"),
            syntaxes[key],
            _labels(known, syntaxes[key]),
            "Numbers are the device's own. "
            + "; ".join(f"{known[number][0]}({number}): {known[number][1]}" for number in sorted(known))
            + ".",
        )
        for key, known in labels.items()
    }


def _labels(known: Mapping[int, tuple[str, str]], syntax: Syntax) -> tuple[tuple[int, str], ...]:
    """Number and label; RFC 2578 wants a BITS to begin with bit 0, so that has one where the map names none."""
    named = {number: name for number, (name, _) in known.items()}
    if syntax is Syntax.BITS:
        named.setdefault(0, "reserved0")
    return tuple((number, named[number]) for number in sorted(named))


def _number_getter(point: str, cell: Callable[[Value], CellValue]) -> Callable[[DeviceRow, float], CellValue]:
    def get(row: DeviceRow, _now: float) -> CellValue:
        value = row.device.snapshot.shown().get(point)
        return None if value is None else cell(value)

    return get


def _text_getter(point: str) -> Callable[[DeviceRow, float], CellValue]:
    def get(row: DeviceRow, _now: float) -> CellValue:
        value = row.device.snapshot.shown_texts().get(point)
        return None if value is None else text(value)

    return get
