"""Snapshots as samples."""

from __future__ import annotations

from dataclasses import replace

import pytest

from gateway.core.site import Site
from gateway.core.snapshot import DeviceState, Snapshot
from gateway.devices.model import Kind
from gateway.devices.schema import load_map, models
from gateway.errors import MapError
from gateway.faces.http.devices import CONDITIONS, DEVICE_METRICS, DeviceMetrics, point_metric
from gateway.faces.http.exposition import Exposition
from gateway.faces.http.own import Counts
from tests.faces.http.scrapes import parse, scrape

from .conftest import VALUES, ManualClock, UnreadableLine, make_device, make_map, make_point, online


def samples(exposition: Exposition) -> dict[tuple[str, str, str], float]:
    """(sample name, device, extra label) → number, of the controllers' metrics."""
    found = {}
    for family in parse(scrape(exposition)):
        for sample in family.samples:
            if sample.name.startswith("morningstar_"):
                labels = sample.labels
                extra = labels.get("state") or labels.get("bit") or labels.get("condition") or ""
                key = (sample.name, labels["device"], extra)
                assert key not in found, "a series was given twice"
                found[key] = sample.value
    return found


@pytest.fixture
def exposition(site: Site, clock: ManualClock) -> Exposition:
    return Exposition(site, clock, Counts())


def test_values_of_an_online_device(exposition: Exposition) -> None:
    found = samples(exposition)
    assert found["morningstar_battery_voltage_volts", "array-1", ""] == 12.5
    assert found["morningstar_energy_joules_total", "array-1", ""] == 7.2e6
    assert found["morningstar_charge_state", "array-1", "night"] == 0
    assert found["morningstar_charge_state", "array-1", "bulk"] == 1
    assert found["morningstar_array_fault", "array-1", "overcurrent"] == 0
    assert found["morningstar_array_fault", "array-1", "battery_hvd"] == 1


def test_metrics_named_total_are_counters(exposition: Exposition) -> None:
    kinds = {family.name: family.type for family in parse(scrape(exposition))}
    assert kinds["morningstar_energy_joules"] == "counter"
    assert kinds["morningstar_battery_voltage_volts"] == "gauge"


@pytest.mark.parametrize("state", [DeviceState.UNKNOWN, DeviceState.STALE, DeviceState.OFFLINE])
def test_only_the_status_of_a_device_that_is_not_online(
    exposition: Exposition,
    site: Site,
    clock: ManualClock,
    state: DeviceState,
) -> None:  # F66
    site.devices[0].snapshot = online(clock.now, state=state)
    clock.now += 3600
    found = {key: value for key, value in samples(exposition).items() if key[1] == "array-1"}
    assert found == {
        ("morningstar_up", "array-1", ""): 0,
        ("morningstar_last_reply_age_seconds", "array-1", ""): 3600,
        ("morningstar_device_info", "array-1", ""): 1,
        **{("morningstar_device_state", "array-1", other.value): float(other is state) for other in DeviceState},
        **{("morningstar_condition", "array-1", condition): 0 for condition in CONDITIONS},
    }


def test_a_device_that_was_never_heard_has_no_age(exposition: Exposition) -> None:
    found = {key for key in samples(exposition) if key[1] == "array-2"}
    assert {name for name, _, _ in found} == {"morningstar_up", "morningstar_device_state", "morningstar_condition"}


def test_a_metric_without_samples_is_not_mentioned(exposition: Exposition, site: Site) -> None:
    site.devices[0].snapshot = Snapshot()
    assert "morningstar_battery_voltage_volts" not in {family.name for family in parse(scrape(exposition))}


def test_a_value_that_is_not_there_is_a_series_that_is_not_there(
    exposition: Exposition,
    site: Site,
    clock: ManualClock,
) -> None:
    values = {name: value for name, value in VALUES.items() if name != "battery_voltage"}
    site.devices[0].snapshot = online(clock.now, values=values)
    found = samples(exposition)
    assert ("morningstar_battery_voltage_volts", "array-1", "") not in found
    assert found["morningstar_up", "array-1", ""] == 1


def test_states_and_bits_without_a_name_are_seen_while_they_last(
    exposition: Exposition,
    site: Site,
    clock: ManualClock,
) -> None:
    site.devices[0].snapshot = online(clock.now, values={"charge_state": 17, "array_fault": 0b10_0000_0001})
    found = {key[::2]: value for key, value in samples(exposition).items()}
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
    exposition = Exposition(Site.of("ridge-07", [line], devices), clock, Counts())
    [family] = [each for each in parse(scrape(exposition)) if each.name == "morningstar_battery_voltage_volts"]
    assert [sample.labels["model"] for sample in family.samples] == ["sun-1", "moon-2"]


def test_models_that_disagree_about_a_metric_are_refused(clock: ManualClock) -> None:
    line = UnreadableLine("shelter-a")
    other = make_map(make_point("charge_state", "morningstar_charge_state"), model="moon-2")
    devices = [make_device("one", 1, line), make_device("two", 2, line, other)]
    with pytest.raises(MapError, match=r"moon-2: point charge_state: metric morningstar_charge_state"):
        DeviceMetrics(Site.of("ridge-07", [line], devices))


def test_conditions_are_told_whatever_the_state(exposition: Exposition, site: Site) -> None:
    site.devices[1].snapshot = Snapshot(warnings=frozenset({"identity_mismatch", "of_tomorrow"}))
    found = {
        key[2]: value for key, value in samples(exposition).items() if key[:2] == ("morningstar_condition", "array-2")
    }
    assert found == {
        "identity_mismatch": 1,
        "slave_control_not_refreshed": 0,
        "unknown_model": 0,
        "of_tomorrow": 1,
    }


@pytest.mark.parametrize("model", models())
def test_every_metric_of_every_model_is_collected_once(model: str, clock: ManualClock) -> None:
    device_map = load_map(model)
    line = UnreadableLine("shelter-a")
    device = make_device("one", 1, line, device_map)
    texts = {point.name: "a" for point in device_map.points if point.kind is Kind.TEXT}
    device.snapshot = replace(
        online(clock.now),
        values={point.name: 1 for point in device_map.points if point.kind is not Kind.TEXT},
        texts=texts,
    )
    found = samples(Exposition(Site.of("ridge-07", [line], [device]), clock, Counts()))
    wanted = {info.name for info in map(point_metric, device_map.points) if info is not None}
    assert {name for name, _, _ in found} == wanted | {info.name for info in DEVICE_METRICS}
