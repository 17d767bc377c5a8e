"""A virtual day hangs together."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import groupby
from typing import Any

import pytest

from gateway.devices.model import DeviceMap, Space
from gateway.simulator.charger import CHARGING
from gateway.simulator.device import SimulatedController
from gateway.simulator.sky import Sky

HOUR = 3600.0
DAY = 24 * HOUR
SEEDS = [0, 1, 2]
Make = Callable[..., SimulatedController]


@pytest.fixture
def make(prostar_map: DeviceMap) -> Make:
    def build(**options: Any) -> SimulatedController:
        unit = SimulatedController(prostar_map, **{"start_hour": 0.0, **options})
        unit.advance(0.0)
        return unit

    return build


def seconds(unit: SimulatedController, until: float, step: float = 10.0) -> Iterator[float]:
    now = 0.0
    while now < until:
        now += step
        unit.advance(now)
        yield now


@pytest.mark.parametrize("seed", SEEDS)
def test_the_numbers_of_every_moment_hang_together(make: Make, seed: int) -> None:
    unit = make(seed=seed)
    points = unit.day.points
    for _ in seconds(unit, 2 * DAY, 20.0):
        now = unit.day.now
        assert now.net_a == pytest.approx(now.charge_a - now.load_a)
        assert now.output_w == pytest.approx(now.charge_a * now.battery_v)
        assert now.array_v * now.array_a == pytest.approx(now.output_w / 0.965)
        assert 0 <= now.charge_a <= unit.plant.rated_a
        assert now.output_w <= unit.plant.array_w
        assert now.array_v <= unit.plant.array_voc_v * 1.05
        assert 11.0 * points.multiplier < now.battery_v < points.hvd_v
        assert 10 < now.ambient_c < 40
        assert now.ambient_c - 1 < now.heatsink_c < 90
        if unit.day.charger.stage not in CHARGING:
            assert now.charge_a == 0 or unit.day.charger.stage == "night_check"


@pytest.mark.parametrize("seed", SEEDS)
def test_what_is_charged_and_not_used_stays_in_the_battery(make: Make, seed: int) -> None:
    unit = make(seed=seed)
    before = unit.day.battery.soc
    charge, load = unit.day.totals.charge_ah, unit.day.totals.load_ah
    unit.advance(2 * DAY)
    charged, used = unit.day.totals.charge_ah - charge, unit.day.totals.load_ah - load
    stored = (unit.day.battery.soc - before) * unit.plant.battery_ah
    assert charged > 0
    assert used > 0
    assert stored <= charged - used + 0.5
    assert stored >= 0.7 * charged - used


def test_the_stages_of_a_good_day_come_in_their_order(make: Make) -> None:
    unit = make(seed=0)
    stages = [stage for stage, _ in groupby(unit.day.charger.stage for _ in seconds(unit, DAY))]
    assert stages == ["night", "night_check", "mppt", "absorption", "float", "mppt", "night_check", "night"]


def test_a_unit_that_is_due_equalizes(make: Make) -> None:
    unit = make(seed=1)
    stages = {unit.day.charger.stage for _ in seconds(unit, 2 * DAY)}
    assert "equalize" in stages
    assert unit.memory.get("time_since_equalize") == 1


def test_a_tight_installation_loses_its_load_and_gets_it_back(make: Make) -> None:
    unit = make(seed=2)
    stages = [str(stage) for stage, _ in groupby(unit.day.load.stage for _ in seconds(unit, 4 * DAY))]
    off = stages.index("lvd")
    assert stages[off - 1] == "lvd_warning"
    assert stages[off + 1] == "load_on"


def test_low_voltage_cuts_the_load_after_the_warning_time_and_raises_an_alarm(make: Make) -> None:
    unit = make(seed=2)
    low = next(now for now in seconds(unit, 4 * DAY) if unit.day.load.stage == "lvd")
    alarm = unit.day.masks.lvd
    unit.advance(low + 10)
    assert unit.memory.get("load_current") == 0
    assert int(unit.memory.get("alarms") or 0) & alarm


def test_absorption_holds_the_compensated_set_point_for_its_time(make: Make) -> None:
    unit = make(seed=0)
    held = []
    for _ in seconds(unit, DAY):
        if unit.day.charger.stage == "absorption":
            held.append(unit.day.now.battery_v - unit.day.charger.target_v)
            warm = unit.day.battery_c - 25
            assert unit.day.charger.target_v == pytest.approx(14.4 - 0.03 * warm, abs=0.02)
    assert max(map(abs, held)) < 0.3
    assert unit.day.totals.charge_ah > 0
    assert unit.day.today.absorption_s == 0 or unit.day.closed == []


def test_the_day_closes_at_dusk_and_begins_again(make: Make) -> None:
    unit = make(seed=0)
    unit.advance(18 * HOUR)
    assert unit.memory.get("charge_today") == pytest.approx(unit.day.today.charge_ah, rel=0.001)
    assert float(unit.memory.get("absorption_time_today") or 0) == pytest.approx(3 * HOUR, abs=60)
    assert float(unit.memory.get("float_time_today") or 0) > HOUR
    unit.advance(19 * HOUR)
    assert float(unit.memory.get("charge_today") or 0) == 0
    assert unit.memory.get("absorption_time_today") == 0
    assert unit.memory.get("array_voltage_maximum_today") == pytest.approx(0.4, abs=0.01)


def test_a_hot_heatsink_limits_the_output_and_is_remembered_today(make: Make) -> None:
    unit = make(seed=0)
    hot = next(now for now in seconds(unit, 7 * DAY) if unit.day.conditions.heatsink_hot)
    assert 8 * HOUR < hot % DAY < 16 * HOUR
    mask = unit.day.masks.heatsink_hot
    assert int(unit.memory.get("alarms") or 0) & mask
    unit.advance(hot + 3 * HOUR)
    assert not int(unit.memory.get("alarms") or 0) & mask
    assert int(unit.memory.get("alarms_today") or 0) & mask


def test_absent_sensors_are_no_value(make: Make) -> None:
    small, large = make(seed=0), make(seed=1)
    assert small.memory.get("inductor_w_temperature") is None
    assert small.memory.get("rts_temperature") is None
    assert large.memory.get("inductor_w_temperature") is not None
    assert large.memory.get("rts_temperature") is not None


def test_a_lost_remote_sensor_is_an_alarm_and_no_value(make: Make) -> None:
    unit = make(seed=1)
    next(now for now in seconds(unit, 20 * DAY, 300.0) if unit.day.conditions.rts_lost)
    assert int(unit.memory.get("alarms") or 0) & unit.day.masks.rts_lost
    assert unit.memory.get("rts_temperature") is None
    assert unit.memory.get("battery_temperature") == unit.memory.get("ambient_temperature")


@pytest.mark.parametrize("seed", SEEDS)
def test_every_value_is_plausible_all_day(make: Make, prostar_map: DeviceMap, seed: int) -> None:
    unit = make(seed=seed)
    for _ in seconds(unit, DAY, 600.0):
        for point in prostar_map.points:
            value = unit.memory.get(point.name)
            if value is not None and point.plausible is not None:
                low, high = point.plausible
                assert low <= value <= high, point.name


@pytest.mark.parametrize("seed", SEEDS)
def test_every_enumeration_value_has_a_name(make: Make, prostar_map: DeviceMap, seed: int) -> None:
    unit = make(seed=seed)
    named = {
        point.name: {entry.number for entry in prostar_map.enumerations[point.enumeration]}
        for point in prostar_map.points
        if point.enumeration is not None and point.space is Space.REGISTERS
    }
    for _ in seconds(unit, 2 * DAY, 300.0):
        for name, numbers in named.items():
            assert unit.memory.get(name) in numbers


def ram(unit: SimulatedController) -> list[int]:
    return unit.memory.read(Space.REGISTERS, 0, 82)


def test_the_same_seed_lives_the_same_life_however_often_it_is_asked(make: Make) -> None:
    watched, left_alone, other = make(seed=0), make(seed=0), make(seed=3)
    for _ in seconds(watched, 2 * HOUR, 1.0):
        pass
    left_alone.advance(2 * HOUR)
    other.advance(2 * HOUR)
    assert ram(watched) == ram(left_alone)
    assert ram(other) != ram(watched)


def test_a_faster_life_is_the_same_life(make: Make) -> None:
    slow, fast = make(seed=0), make(seed=0, speed=120.0)
    slow.advance(12 * HOUR)
    for k in range(360):
        fast.advance(k + 1.0)
    assert fast.day.at_s == pytest.approx(12 * HOUR)
    assert fast.memory.get("charge_today") == pytest.approx(float(slow.memory.get("charge_today") or 0), rel=0.02)
    assert fast.memory.get("charge_state") == slow.memory.get("charge_state")


def test_weather_does_not_depend_on_the_order_of_asking() -> None:
    times = [k * 1700.0 for k in range(300)]
    forward, backward = Sky(5), Sky(5)
    assert [forward.irradiance(t) for t in times] == [backward.irradiance(t) for t in reversed(times)][::-1]
    assert all(0 <= forward.irradiance(t) <= 1.01 for t in times)
    assert forward.irradiance(2 * HOUR) == 0
    assert forward.irradiance(12 * HOUR) > 0.1


def test_high_voltage_set_points_trip_and_recover(make: Make) -> None:
    unit = make(seed=0)
    unit.memory.set("battery_hvd_voltage", 13.0)
    unit.memory.set("battery_hvr_voltage", 12.7)
    unit.memory.set("load_hvd_voltage", 13.0)
    unit.memory.set("load_hvr_voltage", 12.7)
    unit.write(Space.REGISTERS, unit.map.point("setting_change_signal").address, 1, 0.0)
    point = unit.map.point("meterbus_id")
    unit.write(Space.REGISTERS, point.address, 2, 0.0)  # any EEPROM write makes the set points be read again
    faults = set()
    for _ in seconds(unit, 12 * HOUR):
        faults.add((unit.day.array_faults, unit.day.load_faults))
    masks = unit.day.masks
    assert (masks.battery_hvd, masks.load_hvd) in faults
    assert (0, 0) in faults
    assert unit.day.today.array_faults == masks.battery_hvd


@pytest.mark.parametrize("counted", [True, False])
def test_a_model_that_is_only_a_map_has_an_installation_too(prostar_map: DeviceMap, counted: bool) -> None:
    identity = replace(prostar_map.identity, product_prefixes=(), product_codes=("ACME-30",))
    if not counted:
        identity = replace(identity, growing=())
    unit = SimulatedController(replace(prostar_map, model="acme", identity=identity), start_hour=0.0)
    unit.advance(0.0)
    most_a = 0.0
    for _ in seconds(unit, DAY, 60.0):
        now = unit.day.now
        most_a = max(most_a, now.charge_a)
        assert 11.0 < now.battery_v < unit.day.points.hvd_v
    assert unit.plant.product == "ACME-30"
    assert 0.3 * unit.plant.rated_a < most_a <= unit.plant.rated_a
