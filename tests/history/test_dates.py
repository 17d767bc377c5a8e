from __future__ import annotations

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from gateway.history.dates import CLOCK_S, DRIFT, HOUR_S, Look, estimate
from tests.history.blocks import WALL

YEAR_H = 8766


def look_at(real_hours: float, start: float = WALL, off_hours: float = 0.0) -> Look:
    """A look at a controller that was powered `real_hours` since `start` and not for `off_hours`."""
    return Look(int(real_hours), start + (real_hours + off_hours) * HOUR_S)


@given(written=st.floats(1, 20_000), since=st.floats(0, 6000), drift=st.floats(-DRIFT, DRIFT))
def test_the_truth_lies_within_the_bound(written: float, since: float, drift: float) -> None:
    now = Look(int(written + since * (1 + drift)), WALL + (written + since) * HOUR_S)
    found = estimate(int(written), now)
    assert found is not None
    assert abs(found.at - (WALL + written * HOUR_S)) <= found.error_s


@given(
    first=st.floats(1, 20_000),
    after=st.floats(0, 500),
    since=st.floats(0, 500),
    off=st.floats(0, 2000),
    off_before=st.booleans(),
)
def test_hours_without_power_between_two_looks_widen_the_bound(
    first: float, after: float, since: float, off: float, off_before: bool
) -> None:
    before = look_at(first)
    written = first + after
    now = look_at(written + since, off_hours=off)
    truth = WALL + (written + (off if off_before else 0.0)) * HOUR_S
    found = estimate(int(written), now, before)
    assume(int(written) >= before.hours)
    assert found is not None
    assert abs(found.at - truth) <= found.error_s
    assert found.error_s <= (off / 2 + 2) * HOUR_S + CLOCK_S + DRIFT * (after + since) * HOUR_S + 2 * HOUR_S


def test_a_fresh_day_is_right_to_an_hour_and_a_bit() -> None:
    found = estimate(994, Look(1000, WALL))
    assert found is not None
    assert found.at == WALL - 6 * HOUR_S
    assert HOUR_S + CLOCK_S < found.error_s < HOUR_S + CLOCK_S + 30


def test_a_look_before_the_day_says_nothing_of_older_days() -> None:
    old, now = Look(1000, WALL), Look(1100, WALL + 1000 * HOUR_S)
    assert estimate(900, now, old) == estimate(900, now)
    assert estimate(1050, now, old) != estimate(1050, now)


def test_looks_that_contradict_each_other_widen_the_bound() -> None:
    now = Look(1100, WALL + 50 * HOUR_S)  # 100 hours by the hourmeter, 50 by the clock
    found = estimate(1050, now, Look(1000, WALL))
    alone = estimate(1050, now)
    assert found is not None
    assert alone is not None
    assert found.at == alone.at
    assert found.error_s == pytest.approx(alone.error_s + 50 * HOUR_S)


@given(
    hours=st.floats(1000, 2000), ran=st.floats(0, 20), share=st.floats(0, 1), lost=st.floats(2, 24), off=st.floats(0, 9)
)
def test_a_day_from_before_the_power_was_lost_is_within_the_bound(
    hours: float, ran: float, share: float, lost: float, off: float
) -> None:
    """Written `ran` hours before that, while EEPROM had what was `kept` hours old; then `off`, then `on` again."""
    on = share * (20 - ran)
    kept = min(24.0, ran + on + lost)
    now = Look(int(hours + ran - kept + on), WALL + (hours + ran + off + on) * HOUR_S)
    assert int(hours) > now.hours + 1
    for before in (None, look_at(hours - 30)):
        found = estimate(int(hours), now, before)
        assert found is not None
        assert found.at <= now.wall + HOUR_S
        if before is not None or ran + off + on <= 24:
            assert abs(found.at - (WALL + hours * HOUR_S)) <= found.error_s


def test_a_clock_that_was_never_set_makes_no_dates() -> None:
    unset = Look(1000, 86_400.0)
    assert not unset.clock_set
    assert estimate(990, unset) is None
    assert estimate(1010, Look(1020, WALL), unset) == estimate(1010, Look(1020, WALL))


def test_a_pause_too_short_to_be_seen_is_within_the_bound() -> None:
    before, now = look_at(1.5), look_at(3.0, off_hours=1.5)  # hourmeters 1 and 3, three hours apart
    found = estimate(3, now, before)
    assert found is not None
    assert abs(found.at - (WALL + 3.0 * HOUR_S)) <= found.error_s
