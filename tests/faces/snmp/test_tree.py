"""The sorted view: order, successors, what is encoded again and what vanishes."""

from __future__ import annotations

import time
from dataclasses import replace

import pytest

from gateway.core.site import Device, Site
from gateway.core.snapshot import DeviceState, Snapshot
from gateway.core.stats import ModbusServerStats
from gateway.devices.model import DeviceMap
from gateway.faces.snmp import condition_tables, tables
from gateway.faces.snmp.agent import SnmpAgent
from gateway.faces.snmp.objects import Syntax
from gateway.faces.snmp.settings import Oid, SnmpSettings
from gateway.faces.snmp.wire import object_identifier, value, varbind
from tests.faces.snmp.stub_site import StubClock, StubLine, online, stale

SENSOR_VALUE = (1, 3, 6, 1, 2, 1, 99, 1, 1, 1, 4)
LIVE = (1, 3, 6, 1, 4, 1, 32473, 1, 1, 2, 1, 4, 1)
BATTERY_VOLTAGE = 9


def walk(agent: SnmpAgent, now: float) -> list[Oid]:
    found: list[Oid] = []
    at: Oid = (0, 0)
    agent.tree.refresh()
    while (step := agent.tree.after(at, now)) is not None:
        at = step[0]
        found.append(at)
    return found


def test_a_walk_is_strictly_increasing_and_ends(agent: SnmpAgent, clock: StubClock) -> None:
    found = walk(agent, clock.now)
    assert found == sorted(set(found))
    assert len(found) > 300


def test_every_step_can_be_got(agent: SnmpAgent, clock: StubClock) -> None:
    for oid in walk(agent, clock.now):
        assert agent.tree.get(oid, clock.now) == agent.tree.after((*oid[:-1], oid[-1] - 1), clock.now)[1]  # type: ignore[index]


def test_cells_follow_the_snapshot(agent: SnmpAgent, site: Site, device_map: DeviceMap, clock: StubClock) -> None:
    oid = (*LIVE, BATTERY_VOLTAGE, 11)
    device = site.by_unit[11]
    first = agent.tree.get(oid, clock.now)
    snapshot = device.snapshot
    device.snapshot = replace(snapshot, version=2, values={**snapshot.values, "battery_voltage": 12.75})

    second = agent.tree.get(oid, clock.now)

    assert second != first
    assert second == varbind(object_identifier(oid), value(Syntax.INTEGER32, 12750))


def test_a_snapshot_with_the_same_values_reads_the_same(agent: SnmpAgent, site: Site, clock: StubClock) -> None:
    before = walk(agent, clock.now)
    site.by_unit[11].snapshot = replace(site.by_unit[11].snapshot, version=2)
    assert walk(agent, clock.now) == before


def test_values_of_a_stale_device_vanish_and_come_back(
    agent: SnmpAgent, site: Site, device_map: DeviceMap, clock: StubClock
) -> None:
    device = site.by_unit[11]
    whole = walk(agent, clock.now)
    device.snapshot = stale(device.snapshot)
    without = walk(agent, clock.now)
    device.snapshot = online(device_map, 11)

    gone = set(whole) - set(without)
    assert gone == {oid for oid in whole if oid[-1] == 11 and oid[: len(LIVE) - 1][-1] in {4, 5, 6, 7}} | {
        oid for oid in whole if oid[:-1] == SENSOR_VALUE and oid[-1] // 1000 == 11
    }
    assert len(gone) > 90
    assert walk(agent, clock.now) == whole


def test_one_point_can_come_and_go(agent: SnmpAgent, site: Site, clock: StubClock) -> None:
    device = site.by_unit[11]
    oid = (*LIVE, BATTERY_VOLTAGE, 11)
    whole, full = walk(agent, clock.now), device.snapshot
    fewer = {name: shown for name, shown in full.values.items() if name != "battery_voltage"}
    for version in range(2, 6):
        device.snapshot = replace(full, version=version, values=fewer if version % 2 == 0 else full.values)
        sensor = (*SENSOR_VALUE, 11000 + BATTERY_VOLTAGE)
        assert walk(agent, clock.now) == [each for each in whole if version % 2 or each not in {oid, sensor}]


def test_a_point_that_a_device_shows_for_the_first_time_appears(
    agent: SnmpAgent, site: Site, device_map: DeviceMap, clock: StubClock
) -> None:
    device = site.by_unit[12]
    device.snapshot = Snapshot(state=DeviceState.ONLINE, values={"battery_voltage": 12.0})
    first = [oid for oid in walk(agent, clock.now) if oid[-1] == 12]
    device.snapshot = online(device.map, 12)
    later = [oid for oid in walk(agent, clock.now) if oid[-1] == 12]
    assert (*LIVE, BATTERY_VOLTAGE, 12) in first
    assert set(first) < set(later)
    assert len(later) > len(first) + 90


def test_a_step_over_a_site_of_silent_devices_is_short(
    device_map: DeviceMap, settings: SnmpSettings, clock: StubClock, modbus_stats: ModbusServerStats
) -> None:
    """200 devices that show nothing are 100,000 cells; a step must not look at each of them."""
    line = StubLine("a", 1, "/dev/ttyA")
    devices = [Device(f"d{unit}", unit, unit, device_map) for unit in range(1, 201)]
    for device in devices:
        device.line = line
    tree = SnmpAgent(settings, Site.of("big", (line,), devices), clock, modbus_stats).tree
    tree.refresh()
    before = time.thread_time()
    steps = [tree.after(LIVE, clock.now) for _ in range(100)]
    assert time.thread_time() - before < 0.1
    assert steps[0] is not None
    assert steps[0][0][:-4] == (*LIVE[:-2], 8)  # the condition table, which is behind the values
    before = time.thread_time()
    steps = [tree.after((*SENSOR_VALUE, 0), clock.now) for _ in range(10)]
    assert time.thread_time() - before < 0.1
    assert steps[0] is not None
    assert steps[0][0][:-1] == (*SENSOR_VALUE[:-1], 5)


@pytest.mark.parametrize("state", list(DeviceState))
def test_the_device_row_answers_in_every_state(
    agent: SnmpAgent, site: Site, clock: StubClock, state: DeviceState
) -> None:
    device = site.by_unit[21]
    device.snapshot = replace(device.snapshot, state=state)
    row = [oid for oid in walk(agent, clock.now) if oid[:-2] == (*LIVE[:-2], 3, 1) and oid[-1] == 21]
    columns = (*tables.DEVICE, *condition_tables.DEVICE, *tables.DEVICE_SITE)
    assert [oid[-2] for oid in row] == [column.number for column in columns]


def test_ages_and_uptime_come_from_the_monotonic_clock(agent: SnmpAgent, clock: StubClock) -> None:
    age, uptime = (*LIVE[:-2], 3, 1, 12, 11), (1, 3, 6, 1, 2, 1, 1, 3, 0)

    def ticks(oid: Oid, number: int) -> bytes:
        return varbind(object_identifier(oid), value(Syntax.TIME_TICKS, number))

    assert agent.tree.get(uptime, clock.now) == ticks(uptime, 1250)
    assert agent.tree.get(age, clock.now) == ticks(age, 1250)
    assert agent.tree.get(age, clock.now + 1) == ticks(age, 1350)
    assert agent.tree.get(age, clock.now - 60) == ticks(age, 0)  # never negative
    assert agent.tree.get(age, clock.now + 1e9) == ticks(age, 2**32 - 1)  # never young again
    assert agent.tree.get(uptime, clock.now + 2**32 / 100) == ticks(uptime, 1250)  # TimeTicks wrap after 497 days


def test_implemented_objects_are_told_from_others(agent: SnmpAgent) -> None:
    assert agent.tree.has_object((*LIVE, BATTERY_VOLTAGE, 99))
    assert agent.tree.has_object((1, 3, 6, 1, 2, 1, 1, 1, 1))
    assert not agent.tree.has_object((*LIVE, 999, 11))
    assert not agent.tree.has_object((1, 3, 6, 1, 6, 3, 1))


def test_a_step_lands_between_cells(agent: SnmpAgent, clock: StubClock) -> None:
    step = agent.tree.after((*LIVE, BATTERY_VOLTAGE, 11, 5), clock.now)
    assert step is not None
    assert step[0] == (*LIVE, BATTERY_VOLTAGE, 21)  # 12 was never heard
    assert agent.tree.after((2,), clock.now) is None
