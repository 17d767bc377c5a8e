"""Harvests in virtual time: the real keeper, engine and store over simulated controllers."""

from __future__ import annotations

import itertools
import json
import sqlite3
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest

from gateway.devices.log import decode_log, split_blocks
from gateway.devices.model import Space, WordOrder
from gateway.history.database import FILE_NAME
from gateway.simulator.device import SimulatedController
from tests.history.blocks import HI_LO, LAYOUT, LO_HI, MAP
from tests.history.virtual_site import VirtualClock, VirtualGateway, VirtualPort

Row = tuple[Any, ...]


def rows(directory: Path, query: str) -> list[Row]:
    connection = sqlite3.connect(directory / FILE_NAME)
    try:
        return connection.execute(query).fetchall()
    finally:
        connection.close()


def ring_of(controller: SimulatedController) -> dict[int, bytes]:
    """The blocks that the controller holds now."""
    words = controller.memory.read(Space.REGISTERS, LAYOUT.first, LAYOUT.blocks * LAYOUT.block_words)
    return split_blocks(LAYOUT, b"".join(word.to_bytes(2, "big") for word in words))


def truth(controller: SimulatedController) -> dict[int, bytes]:
    """Hourmeter → block of the days in the controller's ring."""
    ring = ring_of(controller)
    return {day.hourmeter: ring[day.slot] for day in decode_log(LAYOUT, ring).days}


def stored(directory: Path, device: str = "array-1") -> dict[int, bytes]:
    found = rows(
        directory, f"SELECT hourmeter, words FROM day JOIN controller ON key = controller WHERE device = '{device}'"
    )
    assert len(dict(found)) == len(found), "one row an hourmeter"
    return dict(found)


@pytest.fixture
def clock() -> VirtualClock:
    return VirtualClock()


def unit(**options: Any) -> SimulatedController:
    return SimulatedController(MAP, **{"step_s": 60.0, **options})


Gateways = Callable[..., VirtualGateway]


@pytest.fixture
def gateway(tmp_path: Path, clock: VirtualClock) -> Gateways:
    def make(*controllers: SimulatedController, live_s: float = 5.0, **options: Any) -> VirtualGateway:
        return VirtualGateway(tmp_path, clock, VirtualPort(clock, list(controllers), live_s), **options)

    return make


@pytest.mark.parametrize("order", [HI_LO, LO_HI])
async def test_the_whole_ring_is_kept_after_the_start(tmp_path: Path, gateway: Gateways, order: WordOrder) -> None:
    controller = unit(seed=0, log_order=order)
    async with gateway(controller) as running:
        await running.until(lambda: running.stats.devices[11].harvests)
        assert stored(tmp_path) == truth(controller)
        assert len(stored(tmp_path)) == 256
        stats = running.stats.devices[11]
        assert (stats.days, stats.apart, dict(stats.failures)) == (256, 0, {})
        reads = [frame for _, frame in running.port.sent if frame[1] == 3 and frame[2] >= 0x80 and frame[2] < 0xE0]
        assert len(reads) == 37  # seven blocks a read
    assert rows(tmp_path, "SELECT DISTINCT word_order FROM day") == [(order.value,)]
    fields = json.loads(rows(tmp_path, "SELECT fields FROM day ORDER BY hourmeter DESC LIMIT 1")[0][0])
    day = decode_log(LAYOUT, ring_of(controller)).days[-1]
    assert fields == day.values
    assert 11 < fields["battery_voltage_minimum"] < 13


DAY_S = 86400.0


async def test_five_days_without_the_gateway_leave_no_gap(
    tmp_path: Path, gateway: Gateways, clock: VirtualClock
) -> None:
    controller = unit(seed=0)
    async with gateway(controller) as running:
        await running.until(lambda: running.stats.devices[11].harvests)
    before = truth(controller)
    clock.now += 5 * DAY_S
    async with gateway(controller) as running:
        await running.until(lambda: running.stats.devices[11].harvests)
        assert running.stats.devices[11].days == 261
        reads = [frame for _, frame in running.port.sent if frame[1] == 3 and 0x80 <= frame[2] < 0xE0]
        assert len(reads) == 1  # what is known is not read again
    after = truth(controller)
    assert len(after.keys() - before.keys()) == 5
    assert stored(tmp_path) == before | after
    dates = rows(tmp_path, "SELECT written_wall, error_s FROM day ORDER BY hourmeter")
    assert all(23 * 3600 < later[0] - earlier[0] < 25 * 3600 for earlier, later in itertools.pairwise(dates))


async def test_five_days_without_the_line_leave_no_gap(tmp_path: Path, gateway: Gateways, clock: VirtualClock) -> None:
    controller = unit(seed=1)
    async with gateway(controller) as running:
        await running.until(lambda: running.stats.devices[11].harvests)
        before = truth(controller)
        running.port.engine.closed("unplugged", clock.now)
        clock.now += 5 * DAY_S
        running.port.engine.opened(clock.now)
        await running.until(lambda: running.stats.devices[11].days == 261)
    assert stored(tmp_path) == before | truth(controller)


async def test_a_day_is_fetched_within_hours_of_its_dusk(
    tmp_path: Path, gateway: Gateways, clock: VirtualClock
) -> None:
    controller = unit(seed=0, start_hour=17.0)
    async with gateway(controller, live_s=60.0) as running:
        await running.until(lambda: running.stats.devices[11].harvests)
        began = clock.now
        await running.until(lambda: running.stats.devices[11].days == 257, seconds=6 * 3600)
        assert clock.now - began < 4.2 * 3600  # dusk is before 19 h, its hour is known, and an hour more
    assert stored(tmp_path).keys() >= truth(controller).keys()


async def test_more_days_away_than_the_ring_holds_is_the_same_controller(
    tmp_path: Path, gateway: Gateways, clock: VirtualClock
) -> None:
    controller = unit(seed=0, step_s=600.0)
    async with gateway(controller) as running:
        await running.until(lambda: running.stats.devices[11].harvests)
    before = truth(controller)
    clock.now += 300 * DAY_S
    async with gateway(controller) as running:
        await running.until(lambda: running.stats.devices[11].harvests)
    after = truth(controller)
    assert not before.keys() & after.keys()
    assert stored(tmp_path) == before | after
    assert rows(tmp_path, "SELECT count(*) FROM controller") == [(1,)]


async def test_an_interrupted_harvest_goes_on_where_it_was(tmp_path: Path, gateway: Gateways) -> None:
    controller = unit(seed=0)
    async with gateway(controller) as running:
        await running.until(lambda: len(running.port.sent) > 25)
        assert running.stats.devices[11].harvests == 0
    staged = rows(tmp_path, "SELECT count(*) FROM staged")[0][0]
    assert 0 < staged < 256
    assert rows(tmp_path, "SELECT count(*) FROM day") == [(0,)]
    async with gateway(controller) as running:
        await running.until(lambda: running.stats.devices[11].harvests)
        reads = [frame for _, frame in running.port.sent if frame[1] == 3 and 0x80 <= frame[2] < 0xE0]
        assert len(reads) <= 1 + (256 - staged + 6) // 7
    assert stored(tmp_path) == truth(controller)
    assert rows(tmp_path, "SELECT count(*) FROM staged") == [(0,)]


@pytest.mark.parametrize("other", [{"seed": 2}, {"seed": 3}, {"seed": 1}])
async def test_a_replaced_controller_starts_a_history_of_its_own(
    tmp_path: Path, gateway: Gateways, other: Mapping[str, Any], caplog: pytest.LogCaptureFixture
) -> None:
    first, second = unit(seed=0), unit(**other)  # younger, as young and older than the first
    async with gateway(first) as running:
        await running.until(lambda: running.stats.devices[11].harvests)
    async with gateway(second) as running:
        await running.until(lambda: running.stats.devices[11].harvests)
    identities = rows(tmp_path, "SELECT identity, key FROM controller ORDER BY key")
    assert [identity for identity, _ in identities] == ["shelter-a/array-1", "shelter-a/array-1/2"]
    for (_, key), controller in zip(identities, (first, second), strict=True):
        assert dict(rows(tmp_path, f"SELECT hourmeter, words FROM day WHERE controller = {key}")) == truth(controller)
    assert "event=history_controller_replaced" in caplog.text
    async with gateway(first) as running:  # and the first one comes back
        await running.until(lambda: running.stats.devices[11].harvests)
    assert len(rows(tmp_path, "SELECT key FROM controller")) == 2


async def test_a_replaced_controller_is_not_mixed_with_what_was_staged_of_the_first(
    tmp_path: Path, gateway: Gateways
) -> None:
    async with gateway(unit(seed=2, firmware=12)) as running:
        await running.until(lambda: len(running.port.sent) > 25)
    second = unit(seed=0)
    async with gateway(second) as running:
        await running.until(lambda: running.stats.devices[11].harvests)
    assert stored(tmp_path) == truth(second)


async def test_a_renamed_device_goes_on_with_its_history(
    tmp_path: Path, gateway: Gateways, clock: VirtualClock
) -> None:
    controller = unit(seed=0)
    async with gateway(controller) as running:
        await running.until(lambda: running.stats.devices[11].harvests)
    running = gateway(controller)
    running.port.devices[0].name = "east"
    running.port.name = "shelter-z"
    async with running:
        await running.until(lambda: running.stats.devices[11].harvests)
        assert running.stats.devices[11].days == 256
    assert rows(tmp_path, "SELECT identity, line, device FROM controller") == [
        ("shelter-a/array-1", "shelter-z", "east")
    ]


async def test_serial_numbers_name_controllers_and_follow_them(tmp_path: Path, gateway: Gateways) -> None:
    one, two = unit(seed=0, serial_number="17340001"), unit(seed=1, serial_number="17340002", address=2)
    async with gateway(one, two) as running:
        await running.until(lambda: all(stats.harvests for stats in running.stats.devices.values()))
    one.address, two.address = 2, 1  # swapped
    async with gateway(two, one) as running:
        await running.until(lambda: all(stats.harvests for stats in running.stats.devices.values()))
    assert rows(tmp_path, "SELECT identity, device FROM controller ORDER BY key") == [
        ("prostar-mppt/17340001", "array-2"),
        ("prostar-mppt/17340002", "array-1"),
    ]
    assert stored(tmp_path, "array-2") == truth(one)
    assert stored(tmp_path, "array-1") == truth(two)
