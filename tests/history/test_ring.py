from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.devices.model import WordOrder
from gateway.history.ring import Apart, Why, read_ring
from tests.history.blocks import EMPTY, ERASED, HI_LO, LAYOUT, LO_HI, block, full_ring, raw

HOURS = [1000 + 24 * day for day in range(256)]


@pytest.mark.parametrize("order", [HI_LO, LO_HI])
@pytest.mark.parametrize("first", [0, 1, 200])
def test_a_ring_comes_out_oldest_first_with_its_words(order: WordOrder, first: int) -> None:
    blocks = full_ring(HOURS, order, first)
    ring = read_ring(LAYOUT, blocks, HOURS[-1] + 5)
    assert [day.hourmeter for day in ring.days] == HOURS
    assert {day.slot: day.words for day in ring.days} == blocks
    assert (ring.order, ring.apart) == (order, ())


def test_blocks_that_were_never_written_are_skipped() -> None:
    blocks = full_ring(HOURS[:3], first=254) | {1: EMPTY, 2: ERASED}
    ring = read_ring(LAYOUT, blocks, HOURS[2])
    assert [(day.slot, day.hourmeter) for day in ring.days] == [(254, 1000), (255, 1024), (0, 1048)]
    assert ring.apart == ()


def test_a_ring_may_be_empty() -> None:
    ring = read_ring(LAYOUT, dict.fromkeys(range(256), ERASED), 3)
    assert (ring.days, ring.apart) == ((), ())


@pytest.mark.parametrize("wrong", [5, 900, 1000 + 24 * 200 + 3])
@pytest.mark.parametrize("slot", [100, 255, 0])
def test_one_wrong_hourmeter_costs_one_block(wrong: int, slot: int) -> None:
    blocks = full_ring(HOURS, first=77) | {slot: block(wrong)}
    ring = read_ring(LAYOUT, blocks, HOURS[-1])
    assert len(ring.days) == 255
    assert ring.apart == (Apart(slot, wrong, block(wrong), Why.ORDER),)


def test_a_block_ahead_of_the_live_hourmeter_is_kept_apart() -> None:
    blocks = full_ring(HOURS) | {9: block(HOURS[-1] + 31)}
    ring = read_ring(LAYOUT, blocks, HOURS[-1] + 5)
    assert [(found.slot, found.why) for found in ring.apart] == [(9, Why.AHEAD)]
    assert 9 not in {day.slot for day in ring.days}


def test_a_day_from_before_the_power_was_lost_is_not_ahead() -> None:
    ring = read_ring(LAYOUT, full_ring(HOURS), HOURS[-1] - 24)
    assert len(ring.days) == 256


def test_a_day_that_ended_while_the_ring_was_read_is_not_ahead() -> None:
    ring = read_ring(LAYOUT, full_ring(HOURS), HOURS[-1] - 1)
    assert len(ring.days) == 256


def test_of_two_days_within_an_hour_the_first_in_ring_order_is_the_day() -> None:
    hours = [1000, 1024, 1024, 1048]
    blocks = {253 + n: block(hour, low_v=12 + n / 8) for n, hour in enumerate(hours[:3])} | {0: block(1048)}
    ring = read_ring(LAYOUT, dict.fromkeys(range(256), EMPTY) | blocks, 1050)
    assert [(day.slot, day.hourmeter) for day in ring.days] == [(253, 1000), (254, 1024), (0, 1048)]
    assert ring.apart == (Apart(255, 1024, blocks[255], Why.TIE),)


def test_two_equal_blocks_are_one_day() -> None:
    ring = read_ring(LAYOUT, {0: block(1000), 1: block(1000), 2: block(1024)}, 1030)
    assert [day.hourmeter for day in ring.days] == [1000, 1024]
    assert ring.apart == ()


def test_a_block_of_another_size_is_refused() -> None:
    with pytest.raises(ValueError, match="30 bytes"):
        read_ring(LAYOUT, {0: bytes(30)}, 10)


@given(st.dictionaries(st.integers(0, 255), st.binary(min_size=32, max_size=32), max_size=40), st.integers(0, 2**32))
def test_every_written_block_is_a_day_or_apart_or_equal_to_a_day(blocks: dict[int, bytes], live: int) -> None:
    ring = read_ring(LAYOUT, blocks, live)
    hours = [day.hourmeter for day in ring.days]
    assert hours == sorted(set(hours))
    assert all(hour <= live + 1 for hour in hours)
    kept = [day.slot for day in ring.days] + [found.slot for found in ring.apart]
    assert len(kept) == len(set(kept))
    days = {(day.hourmeter, day.words) for day in ring.days}
    left_out = raw({slot: words for slot, words in blocks.items() if slot not in kept})
    for words in left_out.values():
        (twin,) = [*read_ring(LAYOUT, {0: words}, 2**33, ring.order).days, None][:1]
        assert twin is None or (twin.hourmeter, words) in days
