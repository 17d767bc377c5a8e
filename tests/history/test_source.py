"""The newest days of a device, for a face that keeps them in memory."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import pytest

from gateway.core.daylog import LoggedDay
from gateway.errors import HistoryError
from gateway.history.dates import HOUR_S
from gateway.history.source import HistorySource
from gateway.history.store import Store
from tests.history.blocks import LAYOUT, PLACE, WALL, full_ring, seen

HOURS = [1000 + 24 * day for day in range(100)]


async def newest(directory: Path, most: int = 256) -> list[LoggedDay]:
    return list(await HistorySource(directory, "ridge").newest(PLACE.line, PLACE.device, most))


async def test_they_come_oldest_first_with_values_and_dates(tmp_path: Path) -> None:
    with closing(Store(tmp_path, session=1)) as store:
        store.keep_ring(seen(HOURS[-1] + 5), LAYOUT, full_ring(HOURS))
    found = await newest(tmp_path)
    assert [day.hourmeter for day in found] == HOURS
    assert (found[-1].values["float_time"], found[-1].values["battery_voltage_maximum"]) == (5400, 14.25)
    assert found[-1].written_at == WALL - 5 * HOUR_S
    assert found[-1].error_s is not None
    assert [day.hourmeter for day in await newest(tmp_path, 3)] == HOURS[-3:]


async def test_they_are_those_of_the_controller_that_is_there_now(tmp_path: Path) -> None:
    with closing(Store(tmp_path, session=1)) as store:
        store.keep_ring(seen(HOURS[-1] + 5, serial="1"), LAYOUT, full_ring(HOURS))
        later = seen(60, serial="2", wall=WALL + HOUR_S)
        store.keep_ring(later, LAYOUT, full_ring([24, 48], volts=11.0))
    assert [day.hourmeter for day in await newest(tmp_path)] == [24, 48]


@pytest.mark.parametrize("step_s", [-400 * 86400.0, -WALL])
async def test_a_clock_that_stands_before_the_last_look_hides_no_replacement(tmp_path: Path, step_s: float) -> None:
    """A site without a battery for its clock, in which a controller is replaced before there is the time."""
    with closing(Store(tmp_path, session=1)) as store:
        store.keep_ring(seen(HOURS[-1] + 5), LAYOUT, full_ring(HOURS))
        ring = full_ring([24, 48], volts=11.0)
        first = store.keep_ring(seen(60, wall=WALL + step_s), LAYOUT, ring)
        again = store.keep_ring(seen(61, wall=WALL + step_s + HOUR_S), LAYOUT, ring)
        assert (first.replaced, again.replaced) == ("shelter-a/array-1", None)
        assert store.counts(PLACE.line, PLACE.device)[0] == 2
        assert [day.hourmeter for day in await newest(tmp_path)] == [24, 48]
        back = store.keep_ring(seen(HOURS[-1] + 6, wall=WALL + step_s), LAYOUT, full_ring(HOURS))
        assert back.controller.identity == "shelter-a/array-1"
    assert [day.hourmeter for day in await newest(tmp_path)] == HOURS


async def test_a_device_that_was_never_harvested_has_none(tmp_path: Path) -> None:
    with closing(Store(tmp_path, session=1)):
        pass
    assert await newest(tmp_path) == []


async def test_a_history_that_is_not_there_is_said(tmp_path: Path) -> None:
    with pytest.raises(HistoryError):
        await newest(tmp_path / "nothing")
