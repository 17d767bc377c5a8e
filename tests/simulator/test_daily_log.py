"""The daily log as the unit keeps it, read with the product's own decoder."""

from __future__ import annotations

from typing import Any

import pytest

from gateway.devices.log import DailyLog, decode_log, split_blocks
from gateway.devices.model import WordOrder

Client = Any
AGE_OF_SEED = {0: 400, 1: 900, 2: 37}


def read_log(client: Client) -> DailyLog:
    layout = client.controller.map.log
    words = [word for block in range(layout.blocks) for word in client.words(layout.first + block * 16, 16)]
    data = b"".join(word.to_bytes(2, "big") for word in words)
    return decode_log(layout, split_blocks(layout, data), int(client.get("hourmeter")))


@pytest.mark.parametrize("order", list(WordOrder))
def test_an_old_unit_has_256_days_in_a_ring(make_client: Any, order: WordOrder) -> None:
    log = read_log(make_client(seed=0, log_order=order))
    assert (len(log.days), log.empty, log.order) == (256, 0, order)
    hours = [day.hourmeter for day in log.days]
    assert hours == [24 * day + 18 for day in range(144, 400)]
    assert log.days[0].slot == 144
    assert log.days[-1].slot == 399 - 256


def test_a_young_unit_has_empty_blocks_of_both_kinds(make_client: Any) -> None:
    client = make_client(seed=2)
    log = read_log(client)
    assert (len(log.days), log.empty) == (37, 219)
    first = client.controller.map.log.first
    assert client.words(first + 37 * 16, 16) == [0] * 16
    assert client.words(first + 38 * 16, 16) == [0xFFFF] * 16


@pytest.mark.parametrize("seed", AGE_OF_SEED)
def test_dusk_writes_the_day_into_the_next_block(make_client: Any, seed: int) -> None:
    client = make_client(seed=seed)
    client.now = 9 * 3600.0
    today = {
        name: client.get(point)
        for name, point in (
            ("battery_voltage_maximum", "battery_voltage_maximum_today"),
            ("array_voltage_maximum", "array_voltage_maximum_today"),
            ("charge", "charge_today"),
            ("absorption_time", "absorption_time_today"),
            ("alarms", "alarms_today"),
        )
    }
    client.now = 11 * 3600.0
    newest = read_log(client).days[-1]
    assert newest.hourmeter == 24 * AGE_OF_SEED[seed] + 18
    assert newest.slot == AGE_OF_SEED[seed] % 256
    assert newest.values["battery_voltage_maximum"] == today["battery_voltage_maximum"]
    assert newest.values["array_voltage_maximum"] == today["array_voltage_maximum"]
    assert newest.values["charge"] == pytest.approx(today["charge"], rel=0.05)
    assert newest.values["absorption_time"] == pytest.approx(today["absorption_time"], abs=60)
    assert newest.values["alarms"] == today["alarms"]


def test_days_that_pass_unasked_are_all_written(make_client: Any) -> None:
    client = make_client(seed=2)
    client.now = 10 * 86_400.0
    log = read_log(client)
    assert len(log.days) == 47
    hours = [day.hourmeter for day in log.days]
    assert hours == sorted(hours)
    assert all(later - earlier == 24 for earlier, later in zip(hours[-10:], hours[-9:], strict=False))
