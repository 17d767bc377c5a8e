"""From a map to columns: numbers, names, units, and when a cell has no value."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from gateway.core.site import Device, Site
from gateway.core.snapshot import DeviceState, Snapshot
from gateway.core.stats import ModbusServerStats
from gateway.devices.model import DeviceMap, EnumValue, MibColumn, Point, Value
from gateway.errors import MapError
from gateway.faces.snmp import tables
from gateway.faces.snmp.counters import SnmpCounters
from gateway.faces.snmp.layout import Layout, label, layout, object_name, shipped_layout
from gateway.faces.snmp.objects import CellValue, DeviceRow, Gateway, LineRow, ObjectType, Syntax, text


def column(described: Layout, name: str) -> ObjectType:
    return next(each for table in described.tables for each in table.columns if each.name == name)


def with_point(device_map: DeviceMap, name: str, **changes: object) -> DeviceMap:
    points = tuple(
        replace(point, **changes) if point.name == name else point  # type: ignore[arg-type]
        for point in device_map.points
    )
    return replace(device_map, points=points)


def cell(device_map: DeviceMap, name: str, value: Value, state: DeviceState = DeviceState.ONLINE) -> CellValue:
    """What the column of point `name` shows for a device whose snapshot has `value`."""
    device = Device("d", 1, 1, device_map)
    device.snapshot = Snapshot(state=state, values={name: value})
    site = Site.of("s", (), [device])
    gateway = Gateway(site, "0", 0.0, ModbusServerStats(), SnmpCounters(), "", "", (1, 3), ())
    return column(layout([device_map]), object_name(name)).get(DeviceRow(gateway, device), 0.0)


def test_every_point_with_a_column_is_in_the_table_of_its_group(device_map: DeviceMap) -> None:
    described = layout([device_map])
    by_name = {table.name: table for table in described.tables}
    for point in device_map.points:
        if point.mib is None:
            continue
        table = by_name["pgw" + point.group.value.capitalize()]
        shown = next(each for each in table.columns if each.number == point.mib.column)
        assert shown.name == object_name(point.name)
        assert shown.units == point.mib.units
        assert shown.description == point.help


def test_names_and_numbers_are_unique() -> None:
    described = shipped_layout()
    objects = [(group.base, each) for group in described.groups for each in group.objects]
    objects += [(table.base, each) for table in described.tables for each in table.columns]
    assert len({each.name for _, each in objects}) == len(objects)
    assert len({(base, each.number) for base, each in objects}) == len(objects)
    assert all(len(each.name) <= 32 for _, each in objects)


def test_the_root_moves_everything() -> None:
    root = (1, 3, 6, 1, 4, 1, 99999, 7)
    described = shipped_layout(root)
    bases = [group.base for group in described.groups] + [table.base for table in described.tables]
    assert all(base[: len(root)] == root for base in [*bases, described.product, described.module])


def test_long_names_use_short_words() -> None:
    assert object_name("battery_voltage") == "pgwBatteryVoltage"
    assert object_name("compensation_temperature_maximum") == "pgwCompensationTemperatureMax"
    assert object_name("compensation_temperature_maximum_of_battery") == "pgwCompensationTempMaxOfBattery"
    with pytest.raises(MapError, match="shorter point name"):
        object_name("a_name_that_no_list_of_short_words_can_save")


def test_labels_are_smiv2() -> None:
    assert label("night_check") == "nightCheck"
    assert label("start2") == "start2"
    with pytest.raises(MapError, match="12v"):
        label("12v")


def test_float16_values_are_milli_units(device_map: DeviceMap) -> None:
    assert cell(device_map, "battery_voltage", 13.2578125) == 13258
    assert cell(device_map, "battery_temperature", -7.5) == -7500
    assert cell(device_map, "charge_total", 429496729.5) == 4294967295


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 2147483.648, -2147483.649, 1e300])
def test_what_does_not_fit_is_not_instantiated(device_map: DeviceMap, value: float) -> None:
    assert cell(device_map, "battery_voltage", value) is None


def test_an_unsigned_column_has_no_negative_value(device_map: DeviceMap) -> None:
    assert cell(device_map, "charge_total", -0.1) is None
    assert cell(device_map, "charge_total", 429496729.6) is None


@pytest.mark.parametrize("state", [DeviceState.UNKNOWN, DeviceState.STALE, DeviceState.OFFLINE])
def test_only_an_online_device_shows_values(device_map: DeviceMap, state: DeviceState) -> None:
    for name in ("battery_voltage", "charge_state", "array_faults"):
        assert cell(device_map, name, 1, state) is None
        assert cell(device_map, name, 1) is not None


def test_a_point_without_a_value_is_not_instantiated(device_map: DeviceMap) -> None:
    device = Device("d", 1, 1, device_map)
    device.snapshot = Snapshot(state=DeviceState.ONLINE)
    gateway = Gateway(Site.of("s", (), [device]), "0", 0.0, ModbusServerStats(), SnmpCounters(), "", "", (1, 3), ())
    assert column(layout([device_map]), "pgwRtsTemperature").get(DeviceRow(gateway, device), 0.0) is None


def test_enumerations_keep_the_devices_numbers(device_map: DeviceMap) -> None:
    shown = column(layout([device_map]), "pgwChargeState")
    assert shown.convention is not None
    assert (1, "nightCheck") in shown.convention.labels
    assert (0, "start") in shown.convention.labels
    assert cell(device_map, "charge_state", 0) == 0
    assert cell(device_map, "charge_state", 99) == 99  # not in the document, still the truth


def test_bit_0_is_the_most_significant_bit_of_the_first_octet(device_map: DeviceMap) -> None:
    assert cell(device_map, "array_faults", 0b1) == b"\x80\x00"
    assert cell(device_map, "array_faults", 1 << 11) == b"\x00\x10"
    assert cell(device_map, "alarms", 1 << 28 | 1) == b"\x80\x00\x00\x08"
    assert cell(device_map, "alarms", 0) == b"\x00\x00\x00\x00"
    assert cell(device_map, "array_faults", 0x10000) is None


def test_two_models_share_a_column(device_map: DeviceMap) -> None:
    other = replace(device_map, model="tristar-mppt")
    assert column(layout([device_map, other]), "pgwBatteryVoltage").models == frozenset(
        {"prostar-mppt", "tristar-mppt"}
    )


@pytest.mark.parametrize(
    ("mib", "wrong"),
    [
        (MibColumn(200, 1000, "millivolts", "Integer32"), "another table or column"),
        (MibColumn(9, 100, "millivolts", "Integer32"), "another scale"),
        (MibColumn(9, 1000, "volts", "Integer32"), "another units"),
        (MibColumn(9, 1000, "millivolts", "Unsigned32"), "another syntax"),
        (MibColumn(1, 1000, "millivolts", "Integer32"), "1 is the index"),
        (MibColumn(9, 1000, "millivolts", "Opaque"), "not known"),
        (MibColumn(9, 1000, "millivolts", "Counter32"), "not for points"),
        (MibColumn(9, 1000, "millivolts", "Bits"), "needs an enumeration or a bit table"),
    ],
)
def test_models_that_disagree_about_a_point_are_refused(device_map: DeviceMap, mib: MibColumn, wrong: str) -> None:
    assert device_map.point("battery_voltage").mib == MibColumn(9, 1000, "millivolts", "Integer32")
    other = replace(with_point(device_map, "battery_voltage", mib=mib), model="tristar-mppt")
    with pytest.raises(MapError, match=wrong):
        layout([device_map, other])


def test_a_number_means_the_same_in_all_models(device_map: DeviceMap) -> None:
    other = replace(
        device_map,
        model="tristar-mppt",
        enumerations={**device_map.enumerations, "charge_state": (EnumValue(1, "bulk", "Bulk"),)},
    )
    with pytest.raises(MapError, match="charge_state 1 has another name"):
        layout([device_map, other])


def test_a_column_number_is_used_once(device_map: DeviceMap) -> None:
    battery: Point = device_map.point("battery_voltage")
    other = with_point(device_map, "array_voltage", mib=battery.mib)
    with pytest.raises(MapError, match="already has another name"):
        layout([other])


def test_text_is_cut_at_a_character() -> None:
    assert text("ü" * 200) == ("ü" * 127).encode()
    assert text("ridge") == b"ridge"


def test_syntaxes_of_the_maps_are_known() -> None:
    assert {Syntax("Integer32"), Syntax("Unsigned32"), Syntax("Enumeration"), Syntax("Bits")} <= set(Syntax)


@pytest.fixture
def line_row(site: Site) -> LineRow:
    """The first line of the site."""
    gateway = Gateway(site, "0", 0.0, ModbusServerStats(), SnmpCounters(), "", "", (1, 3), ())
    return LineRow(gateway, site.lines[0])


def test_the_hog_of_a_line_is_named(line_row: LineRow) -> None:
    stats = line_row.line.stats
    stats.seconds_by_client.update({"192.0.2.7": 1.5, "192.0.2.8": 62.25})
    stats.seconds_by_purpose["client"] = 63.75
    stats.seconds_by_purpose["poll"] = 10.0
    stats.seconds_by_purpose["settle"] = 0.5
    stats.queue_wait.observe(0.25)
    cells = {column.name: column.get(line_row, 0.0) for column in tables.LINE}
    assert cells["pgwLineTopClient"] == b"192.0.2.8"
    assert cells["pgwLineTopClientTime"] == 62250
    assert cells["pgwLineClientTime"] == 63750
    assert cells["pgwLinePollTime"] == 10500
    assert (cells["pgwLineQueueWaits"], cells["pgwLineQueueWaitTime"]) == (1, 250)


def test_a_line_that_nobody_used_has_no_hog(line_row: LineRow) -> None:
    cells = {column.name: column.get(line_row, 0.0) for column in tables.LINE}
    assert (cells["pgwLineTopClient"], cells["pgwLineTopClientTime"]) == (b"", 0)
