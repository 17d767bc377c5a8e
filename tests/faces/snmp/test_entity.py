"""ENTITY-MIB and ENTITY-SENSOR-MIB: from the map, stable, and what an NMS without any definition makes of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from gateway.core.site import Device, Site
from gateway.core.snapshot import Block, DeviceState
from gateway.devices.model import DeviceMap, Identification, MibColumn, Point, Space
from gateway.devices.schema import load_map, models
from gateway.devices.unknown import UNKNOWN
from gateway.errors import MapError
from gateway.faces.snmp import entity
from gateway.faces.snmp.agent import SnmpAgent
from gateway.faces.snmp.objects import EntityRow, Gateway
from gateway.faces.snmp.settings import Oid
from tests.faces.snmp import librenms
from tests.faces.snmp.stub_site import NOW, Ask, StubClock, online, stale

PHYSICAL: Oid = (1, 3, 6, 1, 2, 1, 47, 1, 1, 1, 1)
SENSOR: Oid = (1, 3, 6, 1, 2, 1, 99, 1, 1, 1)
BATTERY_VOLTAGE = 11009

Read = Callable[..., Any]


@pytest.fixture
def read(agent: SnmpAgent, clock: StubClock) -> Read:
    """`read(base, column, index)`: the value of a cell, None when there is none."""

    def cell(base: Oid, column: int, index: int) -> object:
        oid = (*base, column, index)
        slot = next((slot for slot in agent.tree if slot.oid == oid), None)
        assert slot is not None, "the agent has no such cell"
        assert (slot.varbind(clock.now) is None) == (slot.object.get(slot.row, clock.now) is None)
        return slot.object.get(slot.row, clock.now)

    return cell


def indexes(agent: SnmpAgent, base: Oid) -> list[int]:
    return [slot.oid[-1] for slot in agent.tree if slot.oid[:-1] == (*base, 5)]


def test_the_gateway_contains_devices_and_devices_contain_sensors(agent: SnmpAgent, read: Read) -> None:
    found = indexes(agent, PHYSICAL)
    assert found == sorted(set(found))
    assert [index for index in found if index % 1000 == 0] == [11000, 12000, 21000]
    assert [read(PHYSICAL, 5, index) for index in (1, 11000, BATTERY_VOLTAGE)] == [3, 9, 8]
    contained = {index: read(PHYSICAL, 4, index) for index in found}
    assert contained.pop(1) == 0
    assert all(
        container == (1 if index % 1000 == 0 else index // 1000 * 1000) for index, container in contained.items()
    )
    assert indexes(agent, SENSOR) == [index for index in found if index > 1 and index % 1000]


def test_positions_count_within_the_container(agent: SnmpAgent, read: Read) -> None:
    assert read(PHYSICAL, 6, 1) == -1
    assert [read(PHYSICAL, 6, index) for index in (11000, 12000, 21000)] == [1, 2, 3]
    positions = [read(PHYSICAL, 6, index) for index in indexes(agent, SENSOR) if index // 1000 == 12]
    assert positions == list(range(1, len(positions) + 1))


@pytest.mark.parametrize("model", models())
def test_every_measured_point_of_a_map_is_a_sensor(model: str) -> None:
    device_map = load_map(model)
    found = entity.sensors(device_map)
    units = {"V", "A", "W", "°C"}
    assert {point.name for point in found} == {
        point.name
        for point in device_map.points
        if point.group.value == "live" and point.unit in units and not point.setpoint
    }
    columns = [point.mib.column for point in found if point.mib is not None]
    assert columns == sorted(set(columns))
    assert len(columns) == len(found) > 5


def test_what_the_charger_aims_at_is_no_sensor(device_map: DeviceMap) -> None:
    names = {point.name for point in entity.sensors(device_map)}
    assert {"battery_voltage", "charge_current", "charge_power", "heatsink_temperature", "sweep_vmp"} <= names
    assert not names & {"battery_target_voltage", "array_target_voltage", "load_lvd_voltage_in_force"}


def test_an_index_never_runs_into_the_next_device(device_map: DeviceMap) -> None:
    first = device_map.point("battery_voltage")
    far = replace(first, mib=MibColumn(1000, 1000, "millivolts", "Integer32"))
    with pytest.raises(MapError, match="battery_voltage: column 1000"):
        entity.sensors(replace(device_map, points=(far,)))


def test_a_device_tells_who_it_is(read: Read, site: Site) -> None:
    assert [read(PHYSICAL, column, 11000) for column in (2, 7, 8, 9, 11, 12, 13, 16)] == [
        b"Morningstar ProStar MPPT",
        b"array-1",
        b"01.02",
        b"13",
        b"16250001",
        b"Morningstar Corp.",
        b"PS-MPPT-40M",
        1,
    ]
    snapshot = site.by_unit[11].snapshot
    site.by_unit[11].snapshot = replace(snapshot, identification=Identification("x", "y", "R7"), serial_number=None)
    assert [read(PHYSICAL, column, 11000) for column in (8, 9, 11)] == [b"", b"R7", b""]


def test_a_device_that_was_never_heard_says_nothing_wrong(read: Read) -> None:
    assert [read(PHYSICAL, column, 12000) for column in (7, 8, 9, 11, 12, 13)] == [
        b"array-2",
        b"",
        b"",
        b"",
        b"Morningstar Corp.",
        b"",
    ]


def test_the_gateway_tells_its_version(agent: SnmpAgent, read: Read) -> None:
    assert read(PHYSICAL, 3, 1) == agent.layout.product
    assert read(PHYSICAL, 7, 1) == b"ridge-07"
    assert read(PHYSICAL, 2, 1).startswith(b"prostar-gateway ")
    assert read(PHYSICAL, 2, 1).endswith(read(PHYSICAL, 10, 1))


def test_a_value_is_read_by_its_type_scale_and_precision(read: Read, site: Site) -> None:
    assert [read(SENSOR, column, BATTERY_VOLTAGE) for column in range(1, 7)] == [4, 8, 0, 12125, 1, b"millivolts"]
    types = {index: read(SENSOR, 1, index) for index in (11007, 11035, 11017)}
    assert types == {11007: 5, 11035: 6, 11017: 8}
    assert read(SENSOR, 7, BATTERY_VOLTAGE) == 0  # read at the moment of the start
    site.by_unit[11].stats.refresh_s = 1.25
    assert read(SENSOR, 8, BATTERY_VOLTAGE) == 1250


@pytest.mark.parametrize("state", [DeviceState.STALE, DeviceState.OFFLINE])
def test_without_the_device_a_sensor_is_unavailable_and_has_no_value(
    read: Read, site: Site, device_map: DeviceMap, state: DeviceState
) -> None:
    device = site.by_unit[11]
    device.snapshot = replace(stale(device.snapshot), state=state)
    assert [read(SENSOR, column, BATTERY_VOLTAGE) for column in range(1, 6)] == [4, 8, 0, None, 2]
    device.snapshot = online(device_map, 11)
    assert [read(SENSOR, column, BATTERY_VOLTAGE) for column in (4, 5)] == [12125, 1]


def test_a_device_that_was_never_heard_has_unavailable_sensors(read: Read) -> None:
    assert [read(SENSOR, column, 12009) for column in (4, 5, 7)] == [None, 2, 0]


def test_a_sensor_that_is_not_fitted_is_nonoperational(read: Read, site: Site, clock: StubClock) -> None:
    device = site.by_unit[11]
    values = {name: value for name, value in device.snapshot.values.items() if name != "rts_temperature"}
    block = Block(Space.REGISTERS, 0, 82, bytes(164), NOW + 2.0)
    read_at = dict.fromkeys(values, NOW + 2.0)
    device.snapshot = replace(device.snapshot, version=9, values=values, read_at=read_at, blocks=(block,))
    assert [read(SENSOR, column, 11020) for column in (1, 4, 5, 7)] == [8, None, 3, 200]
    device.snapshot = replace(device.snapshot, version=10, blocks=())
    assert read(SENSOR, 5, 11020) == 2  # its register was not read, so nobody knows


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 1e7, -1e7])
def test_what_is_no_value_or_does_not_fit_is_not_said(read: Read, site: Site, value: float) -> None:
    device = site.by_unit[11]
    values = {**device.snapshot.values, "battery_voltage": value}
    device.snapshot = replace(device.snapshot, version=9, values=values)
    assert read(SENSOR, 4, BATTERY_VOLTAGE) is None
    assert read(SENSOR, 5, BATTERY_VOLTAGE) == 2


def test_another_device_moves_no_index(agent: SnmpAgent, site: Site, device_map: DeviceMap) -> None:
    added = Device("array-0", 5, 3, device_map)
    added.line = site.lines[0]
    gateway = next(slot for slot in agent.tree).row
    assert isinstance(gateway, Gateway)
    more = replace(gateway, site=Site.of("more", site.lines, [*site.devices, added]))
    before, after = (
        {row.number: row for row in map(rows.row, range(rows.size)) if isinstance(row, EntityRow)}
        for rows in map(entity.entities, (gateway, more))
    )
    assert {index: (row.device, row.point) for index, row in after.items() if row.device is not added} == {
        index: (row.device, row.point) for index, row in before.items()
    }
    assert {index // 1000 for index in after.keys() - before.keys()} == {5}


def test_a_model_that_is_found_while_the_rows_are_made_is_for_the_next_to_be_made(
    agent: SnmpAgent, site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They are made in a thread, beside the lines."""
    gateway = next(slot for slot in agent.tree).row
    assert isinstance(gateway, Gateway)
    device, sensors = site.devices[0], entity.sensors
    device.map = UNKNOWN
    gateway = replace(gateway, site=Site.of("small", site.lines, [device]))

    def found_meanwhile(device_map: DeviceMap) -> list[Point]:
        device.map = load_map("tristar-mppt")
        return sensors(device_map)

    monkeypatch.setattr(entity, "sensors", found_meanwhile)
    rows = entity.entities(gateway, sensors_only=True)
    assert device not in rows.devices(0, rows.size)
    rows = entity.entities(gateway, sensors_only=True)
    assert device in rows.devices(0, rows.size)


async def discovered(ask: Ask) -> dict[str, librenms.Sensor]:
    """What LibreNMS discovers, by name."""
    options = ("-c", "public", "-m", "ENTITY-SENSOR-MIB", "-OQUs")
    output = ""
    for column in (*librenms.NAMES, *librenms.COLUMNS, librenms.STATUS):
        module = "ENTITY-MIB" if column in librenms.NAMES else "ENTITY-SENSOR-MIB"
        code, text = await ask("snmpbulkwalk", f"{module}::{column}", options=options)
        assert code == 0, text
        output += text
    found = librenms.discover(librenms.rows(output))
    assert len({sensor.name for sensor in found}) == len(found), "two graphs of one name"
    return {sensor.name.lower(): sensor for sensor in found}


@pytest.mark.peer
async def test_librenms_graphs_volts_amperes_watts_and_degrees(ask: Ask, site: Site, device_map: DeviceMap) -> None:
    found = await discovered(ask)
    expected = entity.sensors(device_map)
    assert len(found) == 2 * len(expected)  # 11 and 21 are online, 12 was never heard
    kinds = {"V": "voltage", "A": "current", "W": "power", "°C": "temperature"}
    for device in (site.by_unit[11], site.by_unit[21]):
        for point in expected:
            words = f"{device.name} {point.name.replace('_', ' ')}"
            sensor = found[words.replace("temperature", "")]
            assert sensor.kind == kinds[point.unit]
            assert sensor.value == device.snapshot.values[point.name]
            assert sensor.divisor == 1000


@pytest.mark.peer
async def test_librenms_polls_by_number_and_drops_what_is_unavailable(ask: Ask, site: Site) -> None:
    before = await discovered(ask)
    sensor = before["array-1 battery voltage"]
    code, output = await ask("snmpget", sensor.oid, options=("-c", "public", "-OQUnt"))
    assert (code, float(output.split(" = ")[1]) * sensor.multiplier / sensor.divisor) == (0, sensor.value)
    site.by_unit[11].snapshot = stale(site.by_unit[11].snapshot)
    _, output = await ask("snmpget", sensor.oid, options=("-c", "public", "-OQUnt"))
    assert "No Such Instance" in output
    assert {name.split()[0] for name in before} == {"array-1", "array-3"}
    assert {name.split()[0] for name in await discovered(ask)} == {"array-3"}


@pytest.mark.peer
async def test_net_snmp_reads_every_cell_with_its_type(ask: Ask) -> None:
    whole = ""
    for module, table in (("ENTITY-MIB", "entPhysicalTable"), ("ENTITY-SENSOR-MIB", "entPhySensorTable")):
        code, output = await ask("snmpwalk", f"{module}::{table}", options=("-c", "public", "-m", module))
        assert code == 0
        assert len(output.splitlines()) > 100
        whole += output
    assert "Wrong Type" not in whole
    assert "ENTITY-MIB::entPhysicalClass.11000 = INTEGER: module(9)" in whole
    assert "ENTITY-SENSOR-MIB::entPhySensorType.11009 = INTEGER: voltsDC(4)" in whole
    assert "ENTITY-SENSOR-MIB::entPhySensorScale.11009 = INTEGER: milli(8)" in whole
