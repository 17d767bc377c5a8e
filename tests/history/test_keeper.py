"""Harvests in virtual time: the real keeper, engine and store over simulated controllers."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from gateway.devices.log import decode_log, split_blocks
from gateway.devices.model import Space, WordOrder
from gateway.errors import HistoryError
from gateway.history.database import FILE_NAME
from gateway.history.identity import Place
from gateway.history.session import Session
from gateway.history.store import Store
from gateway.simulator.device import SimulatedController
from gateway.simulator.server import missing
from tests.history.blocks import HI_LO, LAYOUT, LO_HI, MAP, seen
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
        line = running.port.stats
        assert line.seconds_by_client.keys() == {"history"}
        assert line.seconds_by_purpose["background"] > 9
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
    assert all(23 * 3600 < later[0] - earlier[0] < 25 * 3600 for earlier, later in pairwise(dates))


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


# Trouble


def log_reads(running: VirtualGateway) -> list[tuple[float, bytes]]:
    return [(at, frame) for at, frame in running.port.sent if frame[1] == 3 and 0x80 <= frame[2] < 0xE0]


async def test_a_noisy_line_costs_time_and_no_day(tmp_path: Path, gateway: Gateways) -> None:
    controller = unit(seed=0)
    async with gateway(controller) as running:
        for _ in range(60):
            running.port.wire.corrupt_replies(1)
            await running.run(1.7)
        await running.until(lambda: running.stats.devices[11].harvests)
        assert running.stats.devices[11].apart == 0
        assert running.port.engine.stats.failed["crc"] > 20
    assert stored(tmp_path) == truth(controller)


class Picky(SimulatedController):
    """Takes reads of the log of one block only, and not all of them."""

    picky = True

    def read(self, space: Space, first: int, count: int, now: float) -> list[int]:
        if self.picky and 0x8000 <= first < 0x9000 and (count > 16 or first == 0x8000 + 16 * 77):
            raise missing(space, first)
        return super().read(space, first, count, now)


async def test_reads_get_shorter_and_a_refused_block_is_tried_again(tmp_path: Path, gateway: Gateways) -> None:
    controller = Picky(MAP, seed=0, step_s=60.0)
    async with gateway(controller) as running:
        await running.until(lambda: running.stats.devices[11].days == 255)
        stats = running.stats.devices[11]
        assert (stats.harvests, stats.failures["unread_blocks"]) == (0, 1)
        before = len(log_reads(running))
        controller.picky = False
        await running.until(lambda: running.stats.devices[11].harvests)
        assert len(log_reads(running)) > before
    assert stored(tmp_path) == truth(controller)


async def test_a_line_that_fails_on_the_way_costs_nothing(
    tmp_path: Path, gateway: Gateways, clock: VirtualClock
) -> None:
    controller = unit(seed=0)
    async with gateway(controller) as running:
        for _ in range(4):
            reads = len(log_reads(running))
            await running.until(lambda reads=reads: len(log_reads(running)) > reads + 5)  # type: ignore[misc]  # bound
            running.port.engine.closed("unplugged", clock.now)
            await running.run(30.0)
            running.port.wire.clear()
            running.port.engine.opened(clock.now)
        await running.until(lambda: running.stats.devices[11].harvests)
        assert len(log_reads(running)) <= 37 + 4 * 3
        assert running.stats.devices[11].failures["line_down"] >= 1
    assert stored(tmp_path) == truth(controller)


async def test_live_polls_do_not_notice_the_harvest(gateway: Gateways) -> None:
    async with gateway(unit(seed=0), live_s=1.0) as running:
        await running.until(lambda: running.stats.devices[11].harvests)
        live = [at for at, frame in running.port.sent if frame[1] == 3 and frame[2] < 0x80]
        log = [at for at, _ in log_reads(running)]
        assert len(log) == 37
        during = [at for at in live if log[0] <= at <= log[-1]]
        assert during
        gaps = [later - earlier for earlier, later in pairwise(during)]
        assert max(gaps) < 1.01
        device = running.port.devices[0]
        assert device.stats.refresh_s == pytest.approx(1.0, abs=0.01)


async def test_what_cannot_be_stored_disturbs_nobody_and_is_caught_up_later(
    tmp_path: Path, clock: VirtualClock, caplog: pytest.LogCaptureFixture
) -> None:  # F80
    controller = unit(seed=0)
    obstacle = tmp_path / "state"
    obstacle.write_text("a file where the directory should be")
    running = VirtualGateway(obstacle, clock, VirtualPort(clock, [controller], 5.0))
    async with running:
        await running.run(300.0)
        device = running.port.devices[0]
        assert device.snapshot.shown()["hourmeter"] == 9609
        assert (running.stats.store_up, log_reads(running)) == (False, [])
        assert 5 <= running.stats.store_errors["unwritable"] <= 6
        assert "state: is no directory" in caplog.text
        assert caplog.text.count("event=history_store_failed") == 1
        obstacle.unlink()
        await running.until(lambda: running.stats.devices[11].harvests)
        assert running.stats.store_up
        assert "event=history_store_restored" in caplog.text
    assert stored(obstacle) == truth(controller)


async def test_a_file_damaged_while_it_is_used_is_replaced_and_filled(
    tmp_path: Path, gateway: Gateways, clock: VirtualClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    controller = unit(seed=0)

    def damaged(*_arguments: object, **_more: object) -> None:
        raise HistoryError("corrupt", "database disk image is malformed")

    async with gateway(controller) as running:
        await running.until(lambda: running.stats.devices[11].harvests)
        with monkeypatch.context() as patch:
            patch.setattr(Store, "plan", damaged)
            clock.now += DAY_S
            await running.until(lambda: running.stats.store_errors["corrupt"])
        await running.until(lambda: running.stats.devices[11].harvests == 2)
        assert running.stats.store_up
    assert stored(tmp_path) == truth(controller)
    assert set_aside(tmp_path) == 1


async def test_a_file_replaced_in_the_middle_of_a_harvest_gives_no_day_to_another_controller(
    tmp_path: Path, gateway: Gateways, clock: VirtualClock
) -> None:
    """Another line found the damage, and stored its own controller first: that has the key now."""
    controller, other = unit(seed=0), unit(seed=1)
    elsewhere = Place("shelter-b", "array-9", 19)

    def damaged(_store: Store) -> None:
        raise HistoryError("corrupt", "database disk image is malformed")

    async with gateway(controller) as running:
        await running.until(lambda: running.stats.devices[11].harvests)
        reads = len(log_reads(running))
        clock.now += 2 * DAY_S
        while len(log_reads(running)) == reads:
            await running.run(0.02)
        with pytest.raises(HistoryError):
            await running.keeper._store.call(damaged)
        kept = Store(tmp_path, session=9)
        hours = max(truth(other)) + 1
        assert (
            kept.keep_ring(seen(hours, wall=clock.wall(), place=elsewhere), LAYOUT, ring_of(other)).controller.key == 1
        )
        kept.close()
        await running.until(lambda: running.stats.devices[11].harvests == 2)
        assert running.stats.store_up
    assert stored(tmp_path, "array-9") == truth(other)
    assert stored(tmp_path) == truth(controller)


async def test_the_dates_follow_a_clock_that_is_set_while_another_log_is_read(
    tmp_path: Path, gateway: Gateways, clock: VirtualClock
) -> None:
    """The harvest of a long log on a busy line takes hours, and the power may fail before it is over."""
    async with gateway(unit(seed=0), unit(seed=1, address=2)) as running:
        await running.until(lambda: running.stats.devices[11].harvests)
        before = rows(tmp_path, "SELECT max(written_wall) FROM day")[0][0]
        reads = len(log_reads(running))
        clock.wall_offset += 5 * DAY_S
        await running.until(lambda: len(log_reads(running)) >= reads + 3)
        assert not running.stats.devices[12].harvests
        assert rows(tmp_path, "SELECT max(written_wall) FROM day")[0][0] == pytest.approx(before + 5 * DAY_S)
        assert running.stats.moved == 1


async def test_the_dates_follow_a_clock_that_is_set(tmp_path: Path, gateway: Gateways, clock: VirtualClock) -> None:
    async with gateway(unit(seed=0)) as running:
        clock.wall_offset -= 5 * DAY_S
        await running.run(20.0)  # the step is seen before there is anything to move
        await running.until(lambda: running.stats.devices[11].harvests)
        before = rows(tmp_path, "SELECT max(written_wall) FROM day")[0][0]
        clock.wall_offset += 5 * DAY_S
        await running.run(20.0)
        assert rows(tmp_path, "SELECT max(written_wall) FROM day")[0][0] == pytest.approx(before + 5 * DAY_S)
        at = rows(tmp_path, "SELECT look_wall FROM controller")[0][0]
        assert at == pytest.approx(clock.wall(), abs=120)


async def test_a_clock_that_is_set_is_set_once_however_many_lines_there_are(
    tmp_path: Path, gateway: Gateways, clock: VirtualClock
) -> None:
    running = gateway(unit(seed=0))
    for _ in range(3):  # lines with nothing to do look at the clock in step
        others = [running.keeper._watch(device) for device in VirtualPort(clock, [unit()], 5.0).devices]
        running.keeper._lines.append([other for other in others if other is not None])
    async with running:
        await running.until(lambda: running.stats.devices[11].harvests)
        before = rows(tmp_path, "SELECT hourmeter, written_wall FROM day")
        clock.wall_offset += 5 * DAY_S
        await running.run(20.0)
        after = rows(tmp_path, "SELECT hourmeter, written_wall FROM day")
    assert after == [(hours, pytest.approx(at + 5 * DAY_S, abs=1.0)) for hours, at in before]


async def test_what_the_keeper_before_dated_is_moved_too(
    tmp_path: Path, gateway: Gateways, clock: VirtualClock
) -> None:
    """A reload, or a model that was found, begins another keeper in the same run of the gateway."""
    controller, session = unit(seed=0), Session.begin(clock)
    async with gateway(controller, session=session) as running:
        await running.until(lambda: running.stats.devices[11].harvests)
    before = rows(tmp_path, "SELECT hourmeter, written_wall FROM day")
    clock.wall_offset += 5 * DAY_S
    async with gateway(controller, session=session) as running:
        await running.run(20.0)
    after = rows(tmp_path, "SELECT hourmeter, written_wall FROM day")
    assert after == [(hours, pytest.approx(at + 5 * DAY_S, abs=1.0)) for hours, at in before]
    async with gateway(controller) as running:  # another run: its clock was right from the start
        clock.wall_offset -= DAY_S
        await running.run(20.0)
    assert rows(tmp_path, "SELECT hourmeter, written_wall FROM day") == after


async def test_the_sleep_of_the_machine_is_no_step_of_the_clock(
    tmp_path: Path, gateway: Gateways, clock: VirtualClock
) -> None:
    running = gateway(unit(seed=0))
    async with running:
        await running.until(lambda: running.stats.devices[11].harvests)
        before = rows(tmp_path, "SELECT hourmeter, written_wall FROM day")
        clock.now += 7200.0  # both clocks went on (tests/test_clock.py)
        await running.run(20.0)
        assert rows(tmp_path, "SELECT hourmeter, written_wall FROM day") == before


def set_aside(directory: Path) -> int:
    return len(list(directory.glob("*.corrupt-*")))


def spoil_hourmeter(controller: SimulatedController, slot: int, hours: int) -> None:
    controller.memory.store(Space.REGISTERS, LAYOUT.first + 16 * slot, hours >> 16, hours & 0xFFFF)


async def test_days_behind_a_wrong_hourmeter_are_found_all_the_same(
    tmp_path: Path, gateway: Gateways, clock: VirtualClock, caplog: pytest.LogCaptureFixture
) -> None:
    controller = unit(seed=0)
    async with gateway(controller) as running:
        await running.until(lambda: running.stats.devices[11].harvests)
        newest = decode_log(LAYOUT, ring_of(controller)).days[-1].slot
        clock.now += 4 * DAY_S
        controller.advance(clock.now)
        spoil_hourmeter(controller, (newest + 1) % 256, 5)
        await running.until(lambda: running.stats.devices[11].apart == 1)
        assert running.stats.devices[11].days == 256 + 3
    assert "event=history_block_apart" in caplog.text
    assert rows(tmp_path, "SELECT slot, hourmeter, why FROM apart") == [((newest + 1) % 256, 5, "order")]


@pytest.mark.parametrize("order", [HI_LO, LO_HI])
@pytest.mark.parametrize("at_hour", [12.0, 20.0, 23.5])
async def test_a_controller_that_lost_its_power_goes_on_with_its_history(
    tmp_path: Path, gateway: Gateways, clock: VirtualClock, order: WordOrder, at_hour: float
) -> None:
    """Its hourmeter goes on from what EEPROM has since midnight, and after dusk its newest day is ahead of that."""
    controller = unit(seed=0, start_hour=9.0, log_order=order)
    async with gateway(controller) as running:
        await running.until(lambda: running.stats.devices[11].harvests)
    known = truth(controller)
    clock.now += DAY_S + (at_hour - 9.0) * 3600.0
    async with gateway(controller) as running:
        await running.until(lambda: running.stats.devices[11].harvests)
        hours = running.port.devices[0].snapshot.values["hourmeter"]
        known |= truth(controller)
        controller.write(Space.COILS, 0xFF, 1, clock.now)
        await running.until(lambda: running.port.devices[0].snapshot.shown().get("hourmeter", hours) < hours)
    async with gateway(controller) as running:
        await running.until(lambda: running.stats.devices[11].harvests)
        assert running.stats.devices[11].apart == 0
    clock.now += 2 * DAY_S
    async with gateway(controller) as running:
        await running.until(lambda: running.stats.devices[11].harvests)
    assert len(truth(controller).keys() - known.keys()) == 2
    assert rows(tmp_path, "SELECT identity FROM controller") == [("shelter-a/array-1",)]
    assert stored(tmp_path) == known | truth(controller)
    dates = rows(tmp_path, "SELECT written_wall, error_s FROM day ORDER BY hourmeter")
    assert all(earlier[0] < later[0] for earlier, later in pairwise(dates))
    assert all(written <= clock.wall() for written, _ in dates)


async def test_two_controllers_on_a_line_have_a_history_each(tmp_path: Path, gateway: Gateways) -> None:
    one, two = unit(seed=0), unit(seed=2, address=2)
    async with gateway(one, two, live_s=10.0) as running:
        await running.until(lambda: all(stats.harvests for stats in running.stats.devices.values()))
        assert {unit_id: stats.days for unit_id, stats in running.stats.devices.items()} == {11: 256, 12: 37}
    assert stored(tmp_path, "array-1") == truth(one)
    assert stored(tmp_path, "array-2") == truth(two)


async def test_what_is_stored_is_known_again_after_a_restart(
    tmp_path: Path, gateway: Gateways, clock: VirtualClock
) -> None:
    controller = unit(seed=0)
    async with gateway(controller) as running:
        await running.until(lambda: running.stats.devices[11].harvests)
    clock.now += 3600
    running = gateway(Silent(MAP, seed=0))
    async with running:
        await running.run(60.0)
        stats = running.stats.devices[11]
        assert (stats.days, stats.harvests) == (256, 0)
        assert stats.harvested_at is not None
        assert clock.now - stats.harvested_at == pytest.approx(3660, abs=60)


class Silent(SimulatedController):
    def hears(self, now: float) -> bool:
        return False


class Logless(SimulatedController):
    """Refuses every read of the log."""

    def read(self, space: Space, first: int, count: int, now: float) -> list[int]:
        if 0x8000 <= first < 0x9000:
            raise missing(space, first)
        return super().read(space, first, count, now)


async def test_a_controller_without_a_log_is_asked_ever_more_seldom(gateway: Gateways) -> None:
    async with gateway(Logless(MAP, seed=0, step_s=60.0)) as running:
        await running.run(1000.0)
        stats = running.stats.devices[11]
        assert (stats.harvests, stats.failures["refused"]) == (0, 5)  # at 0, 1, 3, 7 and 15 minutes
        assert len(log_reads(running)) < 30
        assert running.port.devices[0].snapshot.shown()


async def test_another_controller_in_the_middle_of_a_harvest_ends_it(
    tmp_path: Path, gateway: Gateways, monkeypatch: pytest.MonkeyPatch
) -> None:
    controller = unit(seed=0)
    async with gateway(controller) as running:
        await running.until(lambda: len(log_reads(running)) > 10)
        snapshot = running.port.devices[0].snapshot
        assert snapshot.identification is not None
        other = replace(snapshot.identification, product="PS-MPPT-40M")
        running.port.devices[0].snapshot = replace(snapshot, identification=other)
        await running.until(lambda: running.stats.devices[11].failures["another_controller"])
        assert stored(tmp_path) == {}
        await running.until(lambda: running.stats.devices[11].harvests)
    assert rows(tmp_path, "SELECT product FROM controller") == [("PS-MPPT-40M",)]
