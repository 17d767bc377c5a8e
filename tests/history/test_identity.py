from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import pytest

from gateway.history.dates import HOUR_S, Look
from gateway.history.identity import Known, Place, Position, Seen, expected, fits, owner
from gateway.history.ring import Ring, read_ring
from tests.history.blocks import HI_LO, LAYOUT, PLACE, WALL, block, full_ring, seen

HOURS = [1000 + 24 * day for day in range(20)]
RING = read_ring(LAYOUT, full_ring(HOURS), HOURS[-1])
NEWEST = Position(19, HOURS[-1], b"", HI_LO)
KNOWN = Known(1, "a", "prostar-mppt", "PS-MPPT-25M", "", PLACE, Look(HOURS[-1] + 1, WALL), NEWEST)


@pytest.mark.parametrize(
    ("who", "same"),
    [
        (seen(HOURS[-1] + 1), True),
        (seen(HOURS[-1] + 1 - 25), True),  # what is lost with the power
        (seen(HOURS[-1] + 1 - 26), False),
        (seen(HOURS[-1] + 9, product="PS-MPPT-40"), False),
        (seen(HOURS[-1] + 9, product=""), True),
        (seen(HOURS[-1] + 9, serial="17340001"), True),
        (replace(seen(HOURS[-1] + 9), model="tristar-mppt"), False),
    ],
)
def test_what_can_be_the_same(who: Seen, same: bool) -> None:
    assert fits(KNOWN, who) is same


def test_another_serial_number_is_another_controller() -> None:
    assert not fits(replace(KNOWN, serial="17340002"), seen(HOURS[-1] + 9, serial="17340001"))


def test_the_serial_number_counts_more_than_the_place() -> None:
    moved = replace(KNOWN, key=2, serial="17340001", place=Place("shelter-b", "array-9", 19))
    who = seen(HOURS[-1] + 9, serial="17340001")
    assert expected([KNOWN, moved], who) is moved
    assert expected([KNOWN, moved], seen(HOURS[-1] + 9)) is KNOWN
    assert expected([KNOWN, moved], who, taken={2}) is KNOWN


def test_of_two_that_were_in_a_place_the_last_one_is_expected() -> None:
    older = replace(KNOWN, key=9, look=Look(HOURS[-1], WALL - 1))
    assert expected([KNOWN, older], seen(HOURS[-1] + 9)) is KNOWN


@pytest.mark.parametrize(
    ("common", "ring", "hours_later", "days_later", "is_known"),
    [
        ({1: 3}, RING, 24, 1, True),
        ({1: 2}, RING, 24, 1, True),  # not the three of a proof, yet nothing speaks against the expected one
        ({}, RING, 24, 1, False),  # days that should be known are not
        ({}, read_ring(LAYOUT, {}, 9999), 24, 1, True),  # the log was cleared
        ({}, read_ring(LAYOUT, {0: block(HOURS[-1] + 24)}, 9999), 48, 2, True),  # and one was written since
        ({}, read_ring(LAYOUT, full_ring([9000, 9024]), 9999), 8000, 333, True),  # away for longer than the ring
        ({}, read_ring(LAYOUT, full_ring([9000, 9024]), 9999), 8000, 10, False),  # grown faster than time
    ],
)
def test_whose_ring_it_is(
    common: Mapping[int, int], ring: Ring, hours_later: int, days_later: int, is_known: bool
) -> None:
    who = seen(KNOWN.look.hours + hours_later, wall=WALL + days_later * 24 * HOUR_S)
    assert owner([KNOWN], who, ring, common) is (KNOWN if is_known else None)


def test_the_same_log_is_the_same_controller_anywhere_but_not_twice() -> None:
    elsewhere = replace(KNOWN, place=Place("x", "y", 3))
    who = seen(HOURS[-1] + 9)
    assert owner([elsewhere], who, RING, {1: 20}) is elsewhere
    assert owner([elsewhere], who, RING, {1: 20}, taken={1}) is None
    assert owner([elsewhere], who, RING, {}) is None


@pytest.mark.parametrize("wall", [1000.0, WALL - 3600])
def test_without_a_right_clock_growth_is_no_evidence(wall: float) -> None:
    who = seen(9999, wall=wall)
    assert owner([KNOWN], who, read_ring(LAYOUT, full_ring([9000, 9024]), 9999), {}) is KNOWN
