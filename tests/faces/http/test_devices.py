"""Snapshots as samples."""

from __future__ import annotations

from dataclasses import replace

import pytest

from gateway.core.site import Site
from gateway.core.snapshot import DeviceState, Snapshot
from gateway.devices.schema import load_map, models
from gateway.errors import MapError
from gateway.faces.http.devices import DEVICE_METRICS, DeviceCollector, point_metric

from .conftest import VALUES, ManualClock, UnreadableLine, make_device, make_map, make_point, online

Labels = tuple[str, ...]


def samples(collector: DeviceCollector) -> dict[tuple[str, str, str], float]:
    """(sample name, device, extra label) → number."""
    found = {}
    for family in collector.collect():
        for sample in family.samples:
            extra = sample.labels.get("state") or sample.labels.get("bit") or ""
            key = (sample.name, sample.labels["device"], extra)
            assert key not in found, "a series was given twice"
            found[key] = sample.value
    return found


@pytest.fixture
def collector(site: Site, clock: ManualClock) -> DeviceCollector:
    return DeviceCollector(site, clock)


def test_values_of_an_online_device(collector: DeviceCollector) -> None:
    found = samples(collector)
    assert found["morningstar_battery_voltage_volts", "array-1", ""] == 12.5
    assert found["morningstar_energy_joules_total", "array-1", ""] == 7.2e6
    assert found["morningstar_charge_state", "array-1", "night"] == 0
    assert found["morningstar_charge_state", "array-1", "bulk"] == 1
    assert found["morningstar_array_fault", "array-1", "overcurrent"] == 0
    assert found["morningstar_array_fault", "array-1", "battery_hvd"] == 1


def test_metrics_named_total_are_counters(collector: DeviceCollector) -> None:
    kinds = {family.name: family.type for family in collector.collect()}
    assert kinds["morningstar_energy_joules"] == "counter"
    assert kinds["morningstar_battery_voltage_volts"] == "gauge"


@pytest.mark.parametrize("state", [DeviceState.UNKNOWN, DeviceState.STALE, DeviceState.OFFLINE])
def test_only_the_status_of_a_device_that_is_not_online(
    collector: DeviceCollector,
    site: Site,
    clock: ManualClock,
    state: DeviceState,
) -> None:  # F66
    site.devices[0].snapshot = online(clock.now, state=state)
    clock.now += 3600
    found = {key: value for key, value in samples(collector).items() if key[1] == "array-1"}
    assert found == {
        ("morningstar_up", "array-1", ""): 0,
        ("morningstar_last_reply_age_seconds", "array-1", ""): 3600,
        ("morningstar_device_info", "array-1", ""): 1,
        **{("morningstar_device_state", "array-1", other.value): float(other is state) for other in DeviceState},
    }


def test_a_device_that_was_never_heard_has_no_age(collector: DeviceCollector) -> None:
    found = {key for key in samples(collector) if key[1] == "array-2"}
    assert {name for name, _, _ in found} == {"morningstar_up", "morningstar_device_state"}


def test_a_metric_without_samples_is_not_mentioned(collector: DeviceCollector, site: Site) -> None:
    site.devices[0].snapshot = Snapshot()
    assert "morningstar_battery_voltage_volts" not in {family.name for family in collector.collect()}


def test_a_value_that_is_not_there_is_a_series_that_is_not_there(
    collector: DeviceCollector,
    site: Site,
    clock: ManualClock,
) -> None:
    values = {name: value for name, value in VALUES.items() if name != "battery_voltage"}
    site.devices[0].snapshot = online(clock.now, values=values)
    found = samples(collector)
    assert ("morningstar_battery_voltage_volts", "array-1", "") not in found
    assert found["morningstar_up", "array-1", ""] == 1


def test_states_and_bits_without_a_name_are_seen_while_they_last(
    collector: DeviceCollector,
    site: Site,
    clock: ManualClock,
) -> None:
    site.devices[0].snapshot = online(clock.now, values={"charge_state": 17, "array_fault": 0b10_0000_0001})
    found = {key[::2]: value for key, value in samples(collector).items()}
    assert {key[1]: value for key, value in found.items() if key[0] == "morningstar_charge_state"} == {
        "night": 0,
        "bulk": 0,
        "value_17": 1,
    }
    assert {key[1]: value for key, value in found.items() if key[0] == "morningstar_array_fault"} == {
        "overcurrent": 1,
        "battery_hvd": 0,
        "bit_9": 1,
    }


def test_models_share_a_metric_by_name(clock: ManualClock) -> None:
    line = UnreadableLine("shelter-a")
    other = make_map(make_point("battery_voltage", "morningstar_battery_voltage_volts"), model="moon-2")
    devices = [make_device("one", 1, line), make_device("two", 2, line, other)]
    for device in devices:
        device.snapshot = online(clock.now)
    collector = DeviceCollector(Site.of("ridge-07", [line], devices), clock)
    [family] = [each for each in collector.collect() if each.name == "morningstar_battery_voltage_volts"]
    assert [sample.labels["model"] for sample in family.samples] == ["sun-1", "moon-2"]


def test_models_that_disagree_about_a_metric_are_refused(clock: ManualClock) -> None:
    line = UnreadableLine("shelter-a")
    other = make_map(make_point("charge_state", "morningstar_charge_state"), model="moon-2")
    devices = [make_device("one", 1, line), make_device("two", 2, line, other)]
    with pytest.raises(MapError, match=r"moon-2: point charge_state: metric morningstar_charge_state"):
        DeviceCollector(Site.of("ridge-07", [line], devices), clock)


@pytest.mark.parametrize("model", models())
def test_every_metric_of_every_model_is_collected_once(model: str, clock: ManualClock) -> None:
    device_map = load_map(model)
    line = UnreadableLine("shelter-a")
    device = make_device("one", 1, line, device_map)
    device.snapshot = replace(online(clock.now), values={point.name: 1 for point in device_map.points})
    found = samples(DeviceCollector(Site.of("ridge-07", [line], [device]), clock))
    wanted = {info.name for info in map(point_metric, device_map.points) if info is not None}
    assert {name for name, _, _ in found} == wanted | {info.name for info in DEVICE_METRICS}
