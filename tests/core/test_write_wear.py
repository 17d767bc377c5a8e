"""How often is too often."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.core.write_wear import DAY_S, Wear, WearLimits
from gateway.devices.model import Space
from gateway.errors import WriteBudgetSpent, WriteTooSoon

CELL = (11, Space.REGISTERS, 0xE000)
OTHER = (12, Space.REGISTERS, 0xE000)


def test_f44_a_register_that_wears_has_a_budget_for_any_24_hours() -> None:
    wear = Wear(WearLimits(per_day=3, interval_s=0.0))
    for at in (0.0, 100.0, 200.0):
        wear.check(CELL, at, wears=True)
        wear.spend(CELL, at, wears=True)
    for at in (201.0, DAY_S - 1):
        with pytest.raises(WriteBudgetSpent, match="0xE000"):
            wear.check(CELL, at, wears=True)
    wear.check(OTHER, 201.0, wears=True)
    wear.check(CELL, DAY_S, wears=True)
    wear.spend(CELL, DAY_S, wears=True)
    with pytest.raises(WriteBudgetSpent):
        wear.check(CELL, DAY_S + 99, wears=True)
    wear.check(CELL, DAY_S + 100, wears=True)


def test_what_does_not_wear_has_an_interval_only() -> None:
    wear = Wear(WearLimits(per_day=1, interval_s=2.0))
    for at in (0.0, 2.0, 4.0):
        wear.check(CELL, at, wears=False)
        wear.spend(CELL, at, wears=False)
    with pytest.raises(WriteTooSoon, match=r"1\.9 s ago"):
        wear.check(CELL, 5.9, wears=False)
    wear.check(OTHER, 5.9, wears=False)


def test_what_did_not_go_out_is_given_back() -> None:
    wear = Wear(WearLimits(per_day=1, interval_s=5.0))
    wear.spend(CELL, 0.0, wears=True)
    wear.take_back(CELL, wears=True)
    wear.check(CELL, 0.1, wears=True)
    wear.spend(CELL, 0.1, wears=False)
    wear.take_back(CELL, wears=False)
    wear.check(CELL, 0.2, wears=False)


def test_what_earlier_runs_wrote_counts_by_its_age() -> None:
    wear = Wear(WearLimits(per_day=2, interval_s=0.0))
    wear.restore(CELL, DAY_S - 10, 1000.0)
    wear.restore(CELL, -5e9, 1000.0)  # the wall clock was wrong then, or is now
    with pytest.raises(WriteBudgetSpent):
        wear.check(CELL, 1009.0, wears=True)
    wear.check(CELL, 1010.0, wears=True)
    wear.spend(CELL, 1010.0, wears=True)
    with pytest.raises(WriteBudgetSpent):
        wear.check(CELL, 1000.0 + DAY_S - 1, wears=True)
    wear.check(CELL, 1000.0 + DAY_S, wears=True)


@given(
    limit=st.integers(1, 4),
    steps=st.lists(st.floats(0, DAY_S, allow_nan=False), max_size=40),
)
def test_never_more_than_the_budget_in_any_day(limit: int, steps: list[float]) -> None:
    wear, now, made = Wear(WearLimits(per_day=limit, interval_s=0.0)), 0.0, list[float]()
    for step in steps:
        now += step
        allowed = True
        try:
            wear.check(CELL, now, wears=True)
        except WriteBudgetSpent:
            allowed = False
        assert allowed is (sum(now - at < DAY_S for at in made) < limit)
        if allowed:
            wear.spend(CELL, now, wears=True)
            made.append(now)
