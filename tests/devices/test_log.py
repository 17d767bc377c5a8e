from __future__ import annotations

import math
import struct
from collections.abc import Sequence

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.devices.log import decode_log, detect_order, split_blocks
from gateway.devices.model import LogLayout, WordOrder
from gateway.devices.schema import load_map

HI_LO, LO_HI = WordOrder.HI_LO, WordOrder.LO_HI


@pytest.fixture(scope="module")
def layout() -> LogLayout:
    found = load_map("prostar-mppt").log
    assert found is not None
    return found


def _block(hourmeter: int, order: WordOrder = HI_LO, *, alarms: int = 0, minutes: Sequence[int] = (0, 0, 0)) -> bytes:
    longs = [hourmeter, alarms, 3, 0x0800]
    pairs = [((value >> 16, value & 0xFFFF) if order is HI_LO else (value & 0xFFFF, value >> 16)) for value in longs]
    words = struct.pack(">8H", *(word for pair in pairs for word in pair))
    return words + struct.pack(">5e3H", 12.5, 14.25, 63.0, math.nan, 71.5, *minutes)


def _ring(hours: Sequence[int], order: WordOrder = HI_LO, turn: int = 0) -> dict[int, bytes]:
    blocks = [_block(hour, order) for hour in hours]
    return dict(enumerate(blocks[turn:] + blocks[:turn]))


def test_a_day_has_every_field_in_base_units(layout: LogLayout) -> None:
    log = decode_log(layout, {7: _block(1000, alarms=0x1000_0001, minutes=(10, 0, 65535))}, 1001)
    (day,) = log.days
    assert (day.slot, day.hourmeter) == (7, 1000)
    assert day.values == {
        "hourmeter": 1000,
        "alarms": 0x1000_0001,
        "load_faults": 3,
        "array_faults": 0x0800,
        "battery_voltage_minimum": 12.5,
        "battery_voltage_maximum": 14.25,
        "charge": 63.0,
        "array_voltage_maximum": 71.5,
        "absorption_time": 600,
        "equalize_time": 0,
        "float_time": 65535 * 60,
    }, "load_charge is NaN and left out"


@pytest.mark.parametrize("order", list(WordOrder))
@pytest.mark.parametrize("turn", [0, 1, 100, 255])
@pytest.mark.parametrize("start", [24, 60_000, 65_500, 131_072])
def test_order_is_found_and_days_are_sorted(layout: LogLayout, order: WordOrder, turn: int, start: int) -> None:
    hours = [start + 24 * day for day in range(256)]
    log = decode_log(layout, _ring(hours, order, turn), hours[-1] + 5)
    assert log.order is order
    assert log.certain
    assert [day.hourmeter for day in log.days] == hours
    assert all(day.values["array_faults"] == 0x0800 for day in log.days)


@given(
    start=st.integers(1, 200_000),
    steps=st.lists(st.integers(1, 48), min_size=2, max_size=255),
    order=st.sampled_from(WordOrder),
    turn=st.integers(0, 255),
)
def test_any_ring_comes_out_in_order(start: int, steps: list[int], order: WordOrder, turn: int) -> None:
    layout = load_map("prostar-mppt").log
    assert layout is not None
    hours = [start]
    for step in steps:
        hours.append(hours[-1] + step)
    log = decode_log(layout, _ring(hours, order, turn % len(hours)), hours[-1])
    assert [day.hourmeter for day in log.days] == hours


@pytest.mark.parametrize("empty", [0, 0x00FF_FFFF, 0xFFFF_FFFF])
@pytest.mark.parametrize("order", list(WordOrder))
def test_blocks_never_written_are_left_out(layout: LogLayout, empty: int, order: WordOrder) -> None:
    blocks = _ring([100, 124, 148], order) | {3: _block(empty, order), 4: _block(empty, order)}
    log = decode_log(layout, blocks, 150)
    assert [day.hourmeter for day in log.days] == [100, 124, 148]
    assert log.empty == 2
    assert log.order is order


def test_an_empty_log_has_no_days_and_the_documents_order(layout: LogLayout) -> None:
    log = decode_log(layout, dict.fromkeys(range(256), bytes(32)), 10)
    assert (log.days, log.order, log.certain, log.empty) == ((), HI_LO, False, 256)


@pytest.mark.parametrize("order", list(WordOrder))
def test_without_a_live_hourmeter_days_that_lie_close_decide_but_not_for_certain(order: WordOrder) -> None:
    pairs = [(0, 100), (0, 124)]
    assert detect_order(pairs if order is HI_LO else [pair[::-1] for pair in pairs]) == (order, False)


def test_one_day_without_a_live_hourmeter_is_read_as_documented() -> None:
    assert detect_order([(0, 100)]) == (HI_LO, False)


def test_two_steps_back_cannot_be_a_ring() -> None:
    assert detect_order([(3, 1), (2, 2), (1, 3), (1, 4)]) == (LO_HI, True)


def test_a_live_hourmeter_decides_even_one_day() -> None:
    assert detect_order([(100, 0)], 101) == (LO_HI, True)
    assert detect_order([(0, 100)], 101) == (HI_LO, True)


def test_reads_of_several_blocks_are_cut(layout: LogLayout) -> None:
    data = _block(24) + _block(48) + _block(72)
    assert split_blocks(layout, data, 5) == {5: _block(24), 6: _block(48), 7: _block(72)}
    with pytest.raises(ValueError, match="95 bytes are not whole blocks of 32"):
        split_blocks(layout, data[:-1])


def test_a_short_block_is_refused(layout: LogLayout) -> None:
    with pytest.raises(ValueError, match="log block 3 has 31 bytes, not 32"):
        decode_log(layout, {3: bytes(31)})


@given(blocks=st.dictionaries(st.integers(0, 255), st.binary(min_size=32, max_size=32), max_size=20))
def test_any_bytes_decode_to_finite_values(blocks: dict[int, bytes]) -> None:
    layout = load_map("prostar-mppt").log
    assert layout is not None
    log = decode_log(layout, blocks, 5000)
    assert len(log.days) + log.empty == len(blocks)
    assert [day.hourmeter for day in log.days] == sorted(day.hourmeter for day in log.days)
    assert all(math.isfinite(value) for day in log.days for value in day.values.values())
