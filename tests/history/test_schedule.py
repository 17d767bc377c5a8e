from __future__ import annotations

import pytest

from gateway.history.schedule import Schedule

WHO = ("PS-MPPT-25M", "")
DAY_S = 86_400.0


@pytest.fixture
def schedule() -> Schedule:
    """Harvested at 0 s with the hourmeter at 1005 and the newest day at 1000."""
    schedule = Schedule(DAY_S)
    schedule.done(0.0, 1005, WHO, 1000)
    return schedule


def test_at_once_after_the_start() -> None:
    assert Schedule(DAY_S).due(0.0, 1000, WHO)


def test_when_a_day_must_have_ended_and_then_every_hour(schedule: Schedule) -> None:
    assert not schedule.due(19 * 3600.0, 1024, WHO)
    assert schedule.due(20 * 3600.0, 1025, WHO)
    schedule.done(20 * 3600.0, 1025, WHO, 1000)  # dusk is later today
    assert not schedule.due(20.9 * 3600, 1025, WHO)
    assert schedule.due(21 * 3600.0, 1026, WHO)
    schedule.done(21 * 3600.0, 1026, WHO, 1025)
    assert not schedule.due(22 * 3600.0, 1027, WHO)


def test_at_the_latest_after_the_interval(schedule: Schedule) -> None:
    assert not schedule.due(DAY_S - 1, 1010, WHO)
    assert schedule.due(DAY_S, 1010, WHO)


def test_at_once_after_an_outage_of_days(schedule: Schedule) -> None:
    assert schedule.due(3601.0, 1125, WHO)


@pytest.mark.parametrize(("hours", "who"), [(1004, WHO), (1006, ("PS-MPPT-40", "")), (1006, (WHO[0], "17340001"))])
def test_at_once_when_another_controller_seems_to_be_there(
    schedule: Schedule, hours: int, who: tuple[str, str]
) -> None:
    assert not schedule.due(60.0, 1006, WHO)
    assert schedule.due(60.0, hours, who)


def test_a_failure_is_tried_again_ever_more_seldom(schedule: Schedule) -> None:
    now, pauses = 0.0, []
    for _ in range(9):
        schedule.failed(now)
        began = now
        while not schedule.due(now, 1006, WHO):
            now += 1.0
        pauses.append(now - began)
    assert pauses == [60, 120, 240, 480, 960, 1920, 3600, 3600, 3600]
    schedule.done(now, 1006, WHO, 1000)
    assert not schedule.due(now + 60, 1006, WHO)


def test_an_interruption_goes_on_at_once(schedule: Schedule) -> None:
    schedule.interrupted(100.0)
    assert schedule.due(100.0, 1006, WHO)


def test_without_any_day_the_interval_decides() -> None:
    schedule = Schedule(DAY_S)
    schedule.done(0.0, 5, WHO, None)
    assert not schedule.due(DAY_S - 1, 29, WHO)
    assert schedule.due(DAY_S, 29, WHO)
