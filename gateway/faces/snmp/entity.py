"""ENTITY-MIB (RFC 6933) and ENTITY-SENSOR-MIB (RFC 3433): the gateway, its devices and what they measure.

An NMS that knows nothing of this gateway graphs volts, amperes, watts and degrees by these two. Rules:

1. Three levels: the gateway is a chassis, each device a module in it, each measured point a sensor in its module. What
   measures is told by the map: live, in one of `SENSOR_TYPES`, and no set point.
2. An index never moves: 1 is the gateway, `unit id x 1000` a device, the MIB column of the point added to it a sensor.
   Unit ids are the operator's, columns are append-only.
3. Type, scale, precision and status always answer. A value is there only while the device is online: otherwise its
   status is unavailable(2). A value that a device that is online does not have is nonoperational(3): no such
   sensor is fitted, or it is broken.
4. What can only be empty (serial number of a sensor) is left out: it would be most of the cells of the whole agent.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from enum import IntEnum

from gateway.core.site import Device
from gateway.core.snapshot import DeviceState
from gateway.devices.model import DeviceMap, Group, Identification, Point
from gateway.errors import MapError
from gateway.faces.snmp.objects import (
    CellValue,
    Changes,
    EntityRow,
    Gateway,
    ObjectType,
    RowKind,
    ScalarGroup,
    Syntax,
    Table,
    text,
)
from gateway.faces.snmp.rows import NumberedRows, Rows
from gateway.faces.snmp.settings import Oid

ENTITY_MIB: Oid = (1, 3, 6, 1, 2, 1, 47)
ENTITY_SENSOR_MIB: Oid = (1, 3, 6, 1, 2, 1, 99)

GATEWAY_INDEX = 1
INDEXES_A_DEVICE = 1000

VALUE_LIMIT = 10**9
"""EntitySensorValue: beyond it a value cannot be said."""


class SensorType(IntEnum):
    """EntitySensorDataType, as far as a map has units for it."""

    VOLTS_DC = 4
    AMPERES = 5
    WATTS = 6
    CELSIUS = 8


SENSOR_TYPES: Mapping[str, SensorType] = {
    "V": SensorType.VOLTS_DC,
    "A": SensorType.AMPERES,
    "W": SensorType.WATTS,
    "°C": SensorType.CELSIUS,
}
"""By the unit of the point."""

SENSOR_SCALES: Mapping[int, int] = {1_000_000: 7, 1000: 8, 1: 9}
"""EntitySensorDataScale by the scale of the MIB column: micro, milli, units."""

_CHASSIS, _SENSOR, _MODULE = 3, 8, 9  # PhysicalClass
_TRUE, _FALSE = 1, 2
_OK, _UNAVAILABLE, _NONOPERATIONAL = 1, 2, 3  # EntitySensorStatus
_UNKNOWN_KIND: Oid = (0, 0)
_REVISION = re.compile(r"v?(\d+\.\d+)\.(\d+)")  # hardware major.minor.software, in the documents of every model


def sensors(device_map: DeviceMap) -> list[Point]:
    """What a model measures, in the order of the indexes; MapError when a column leaves no room for the next device."""
    found = [point for point in device_map.points if _measures(point)]
    for point in found:
        if _column(point) >= INDEXES_A_DEVICE:
            raise MapError(f"{device_map.model}: point {point.name}: column {_column(point)} is too high for an index")
    return sorted(found, key=_column)


def entities(gateway: Gateway, *, sensors_only: bool = False) -> Rows:
    """The physical entities: the gateway, then each device followed by its sensors; or the sensors alone."""
    devices = gateway.site.devices
    order = {device.unit_id: place for place, device in enumerate(devices, start=1)}
    # What a device measures is that of its map now, even if another one is found for it later, or while this is made.
    maps = {device.unit_id: device.map for device in devices}
    measured = {id(each): sensors(each) for each in {id(each): each for each in maps.values()}.values()}
    by_column = {
        key: {_column(point): (position, point) for position, point in enumerate(points, start=1)}
        for key, points in measured.items()
    }
    of_unit = {device.unit_id: (device, by_column[id(maps[device.unit_id])]) for device in devices}

    def row(unit: int, column: int) -> EntityRow:
        if not unit:
            return EntityRow(gateway, GATEWAY_INDEX, 0)
        device, points = of_unit[unit]
        index = unit * INDEXES_A_DEVICE + column
        if not column:
            return EntityRow(gateway, index, order[unit], device=device)
        position, point = points[column]
        return EntityRow(gateway, index, position, device=device, point=point)

    numbers = [] if sensors_only else [GATEWAY_INDEX]
    for unit, (_, points) in of_unit.items():
        columns = points if sensors_only else (0, *points)
        numbers += [unit * INDEXES_A_DEVICE + column for column in columns]

    def model(unit: int) -> int:
        return id(maps[unit]) if unit else 0

    return NumberedRows(numbers, INDEXES_A_DEVICE, row, lambda unit: of_unit[unit][0] if unit else None, model)


def _measures(point: Point) -> bool:
    return (
        point.group is Group.LIVE
        and point.unit in SENSOR_TYPES
        and not point.setpoint
        and point.mib is not None
        and point.mib.syntax == "Integer32"
        and point.mib.scale in SENSOR_SCALES
    )


def _column(point: Point) -> int:
    assert point.mib is not None
    return point.mib.column


Part = Callable[[EntityRow], CellValue]


def _column_of(
    number: int,
    name: str,
    syntax: Syntax,
    parts: tuple[Part, Part, Part | None],
    changes: Changes = Changes.NEVER,
    *,
    alike: bool = False,
) -> ObjectType:
    """A column from what it is for the gateway, a device and a sensor; None: a sensor has no such cell."""
    gateway, device, sensor = parts

    def get(row: EntityRow, _now: float) -> CellValue:
        part = gateway if row.device is None else device if row.point is None else sensor
        return None if part is None else part(row)

    only = None if sensor is not None else lambda row: row.point is None
    return ObjectType(number, name, syntax, "", get, changes=changes, only=only, alike=alike)


def _identified(get: Callable[[Identification], str], configured: Callable[[EntityRow], str] = lambda _row: "") -> Part:
    """What the device told of itself, what is configured as long as it did not."""

    def part(row: EntityRow) -> bytes:
        identification = _device(row).snapshot.identification
        return text(configured(row) if identification is None else get(identification))

    return part


def _revision(group: int) -> Callable[[Identification], str]:
    """Hardware (1) or firmware (2) revision of what the device told; all of it is firmware when it has another form."""

    def part(identification: Identification) -> str:
        found = _REVISION.fullmatch(identification.revision)
        return found[group] if found else identification.revision if group == 2 else ""

    return part


def _device(row: EntityRow) -> Device:
    assert row.device is not None
    return row.device


def _map(row: EntityRow) -> DeviceMap:
    return _device(row).map


def _empty(_row: EntityRow) -> bytes:
    return b""


def _point(row: EntityRow) -> Point:
    assert row.point is not None
    return row.point


def _parent(row: EntityRow) -> int:
    return _device(row).unit_id * INDEXES_A_DEVICE


def _expected_product(row: EntityRow) -> str:
    return _device(row).expected.product or ""


def _serial_number(row: EntityRow) -> bytes:
    return text(_device(row).snapshot.serial_number or "")


def _sensor_name(row: EntityRow) -> bytes:
    return text(f"{_device(row).name} {_point(row).name.replace('_', ' ')}")


_OF_SNAPSHOT = Changes.WITH_SNAPSHOT

PHYSICAL = Table(
    (*ENTITY_MIB, 1, 1, 1),
    1,
    "entPhysical",
    "",
    RowKind.ENTITY,
    "entPhysicalIndex",
    (
        _column_of(
            2,
            "entPhysicalDescr",
            Syntax.TEXT,
            (
                lambda row: text(f"prostar-gateway {row.gateway.version}"),
                lambda row: text(_map(row).title),
                lambda row: text(_point(row).help),
            ),
            alike=True,
        ),
        _column_of(
            3,
            "entPhysicalVendorType",
            Syntax.OBJECT_IDENTIFIER,
            (lambda row: row.gateway.object_id, lambda _row: _UNKNOWN_KIND, None),
        ),
        _column_of(
            4, "entPhysicalContainedIn", Syntax.INTEGER32, (lambda _row: 0, lambda _row: GATEWAY_INDEX, _parent)
        ),
        _column_of(
            5,
            "entPhysicalClass",
            Syntax.ENUMERATION,
            (lambda _row: _CHASSIS, lambda _row: _MODULE, lambda _row: _SENSOR),
            alike=True,
        ),
        _column_of(
            6,
            "entPhysicalParentRelPos",
            Syntax.INTEGER32,
            (lambda _row: -1, lambda row: row.position, lambda row: row.position),
        ),
        _column_of(
            7,
            "entPhysicalName",
            Syntax.TEXT,
            (lambda row: text(row.gateway.site.name), lambda row: text(_device(row).name), _sensor_name),
        ),
        _column_of(8, "entPhysicalHardwareRev", Syntax.TEXT, (_empty, _identified(_revision(1)), None), _OF_SNAPSHOT),
        _column_of(9, "entPhysicalFirmwareRev", Syntax.TEXT, (_empty, _identified(_revision(2)), None), _OF_SNAPSHOT),
        _column_of(10, "entPhysicalSoftwareRev", Syntax.TEXT, (lambda row: text(row.gateway.version), _empty, None)),
        _column_of(11, "entPhysicalSerialNum", Syntax.TEXT, (_empty, _serial_number, None), _OF_SNAPSHOT),
        _column_of(
            12,
            "entPhysicalMfgName",
            Syntax.TEXT,
            (_empty, _identified(lambda told: told.vendor, lambda row: _map(row).identity.vendor), None),
            _OF_SNAPSHOT,
        ),
        _column_of(
            13,
            "entPhysicalModelName",
            Syntax.TEXT,
            (lambda _row: b"prostar-gateway", _identified(lambda told: told.product, _expected_product), None),
            _OF_SNAPSHOT,
        ),
        _column_of(14, "entPhysicalAlias", Syntax.TEXT, (_empty, _empty, None)),
        _column_of(15, "entPhysicalAssetID", Syntax.TEXT, (_empty, _empty, None)),
        _column_of(
            16,
            "entPhysicalIsFRU",
            Syntax.ENUMERATION,
            (lambda _row: _TRUE, lambda _row: _TRUE, lambda _row: _FALSE),
            alike=True,
        ),
    ),
)


def _value(row: EntityRow) -> CellValue:
    point = _point(row)
    assert point.mib is not None
    value = _device(row).snapshot.shown().get(point.name)
    if value is None or not math.isfinite(scaled := value * point.mib.scale):
        return None
    number = round(scaled)
    return number if abs(number) <= VALUE_LIMIT else None


def _status(row: EntityRow) -> int:
    snapshot = _device(row).snapshot
    if _value(row) is not None:
        return _OK
    was_read = snapshot.state is DeviceState.ONLINE and snapshot.block_of(_point(row)) is not None
    return _NONOPERATIONAL if was_read else _UNAVAILABLE


def _read_at(row: EntityRow) -> int:
    """The sysUpTime when the value or its absence was last read; 0 before."""
    snapshot = _device(row).snapshot
    at = snapshot.read_at.get(_point(row).name)
    if at is None:
        block = snapshot.block_of(_point(row))
        at = None if block is None else block.read_at
    return 0 if at is None else row.gateway.ticks(at)


def _update_rate(row: EntityRow) -> int:
    return round((_device(row).stats.refresh_s or 0.0) * 1000)


def _scale(row: EntityRow) -> int:
    mib = _point(row).mib
    assert mib is not None
    return SENSOR_SCALES[mib.scale]


def _units(row: EntityRow) -> bytes:
    mib = _point(row).mib
    assert mib is not None
    return text(mib.units)


def _of_sensor(number: int, name: str, syntax: Syntax, part: Part, changes: Changes = Changes.NEVER) -> ObjectType:
    return ObjectType(
        number,
        name,
        syntax,
        "",
        lambda row, _now: part(row),
        changes=changes,
        of_values=part is _value,
        alike=changes is Changes.NEVER,
    )


SENSORS = Table(
    (*ENTITY_SENSOR_MIB, 1, 1),
    1,
    "entPhySensor",
    "",
    RowKind.SENSOR,
    "entPhysicalIndex",
    (
        _of_sensor(1, "entPhySensorType", Syntax.ENUMERATION, lambda row: int(SENSOR_TYPES[_point(row).unit])),
        _of_sensor(2, "entPhySensorScale", Syntax.ENUMERATION, _scale),
        # Values are whole numbers of the scaled unit: there are no decimal places to tell of.
        _of_sensor(3, "entPhySensorPrecision", Syntax.INTEGER32, lambda _row: 0),
        _of_sensor(4, "entPhySensorValue", Syntax.INTEGER32, _value, _OF_SNAPSHOT),
        _of_sensor(5, "entPhySensorOperStatus", Syntax.ENUMERATION, _status, _OF_SNAPSHOT),
        _of_sensor(6, "entPhySensorUnitsDisplay", Syntax.TEXT, _units),
        _of_sensor(7, "entPhySensorValueTimeStamp", Syntax.TIME_STAMP, _read_at, _OF_SNAPSHOT),
        _of_sensor(8, "entPhySensorValueUpdateRate", Syntax.UNSIGNED32, _update_rate, Changes.ALWAYS),
    ),
    index_of="entPhysical",
)

GENERAL = ScalarGroup(
    (*ENTITY_MIB, 1, 4),
    4,
    "entityGeneral",
    "",
    # What is configured is read once, at the start.
    (ObjectType(1, "entLastChangeTime", Syntax.TIME_STAMP, "", lambda _gateway, _now: 0, changes=Changes.NEVER),),
)

TABLES: tuple[Table, ...] = (PHYSICAL, SENSORS)
CAPABILITIES: tuple[tuple[Oid, str], ...] = (
    (ENTITY_MIB, "ENTITY-MIB: the gateway, its devices and their sensors, read-only"),
    (ENTITY_SENSOR_MIB, "ENTITY-SENSOR-MIB: what the devices measure"),
)
