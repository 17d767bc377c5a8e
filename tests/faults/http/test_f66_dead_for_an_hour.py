"""F66: a controller is dead for an hour. Its series vanish, what says so stays, and no line goes on flat."""

from __future__ import annotations

from tests.faults.http.plant import Plant

STATUS = {
    "morningstar_up",
    "morningstar_last_reply_age_seconds",
    "morningstar_device_state",
    "morningstar_device_info",
    "morningstar_condition",
}
MAX_AGE_S = 5.0


def values(scrape: dict[str, float]) -> set[str]:
    """The names of what was measured."""
    return {name.partition("{")[0] for name in scrape if name.startswith("morningstar_")} - STATUS


def test_values_vanish_within_max_age_and_the_age_grows() -> None:
    plant = Plant()
    plant.run(10.0)
    assert plant.scrape()["morningstar_battery_voltage_volts"] == 12.5
    assert len(values(plant.scrape())) > 80

    plant.controller.silent = True
    died_at = plant.now
    last_seen_s = 0.0
    while plant.now < died_at + 60.0:
        plant.run(0.5)
        if values(plant.scrape()):
            last_seen_s = plant.now - died_at
    assert last_seen_s <= MAX_AGE_S
    ages = []
    while plant.now < died_at + 3600.0:
        plant.run(60.0)
        found = plant.scrape()
        assert values(found) == set()
        assert found["morningstar_up"] == 0
        assert found["morningstar_device_state{offline}"] == 1
        ages.append(found["morningstar_last_reply_age_seconds"])
    assert ages == sorted(ages)
    assert 3595.0 < ages[-1] < 3605.0

    plant.controller.memory.set("battery_voltage", 12.25)
    plant.controller.silent = False
    plant.run(70.0)
    found = plant.scrape()
    assert found["morningstar_up"] == 1
    assert found["morningstar_battery_voltage_volts"] == 12.25
    assert found["morningstar_last_reply_age_seconds"] < 2.0
    assert found["prostar_gateway_device_offline_total"] == 1
