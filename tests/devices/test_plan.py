from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.devices.forms import parse_map
from gateway.devices.model import DeviceMap, PollClass, Space
from gateway.devices.plan import PlannedBlock, poll_plan, split
from gateway.devices.schema import load_map, models

REGISTERS = Space.REGISTERS


def _points_in(device_map: DeviceMap, block: PlannedBlock) -> set[str]:
    return {
        point.name
        for point in device_map.points
        if point.space is block.space and block.first <= point.address and point.address + point.words - 1 <= block.last
    }


def test_prostar_is_three_reads() -> None:
    assert poll_plan(load_map("prostar-mppt")) == (
        PlannedBlock(REGISTERS, 0x0000, 82, PollClass.LIVE),
        PlannedBlock(REGISTERS, 0xE000, 80, PollClass.SETTINGS),
        PlannedBlock(Space.COILS, 0x0000, 3, PollClass.LIVE),
    )


@pytest.mark.parametrize("model", models())
def test_every_shown_point_is_read_once(model: str) -> None:
    device_map = load_map(model)
    read = [name for block in poll_plan(device_map) for name in _points_in(device_map, block)]
    shown = {point.name for point in device_map.points if point.polled}
    assert shown <= set(read)
    assert len(read) == len(set(read))


@pytest.mark.parametrize("model", models())
def test_register_blocks_of_a_device_differ_in_length(model: str) -> None:
    counts = [block.count for block in poll_plan(load_map(model)) if block.space is REGISTERS]
    assert len(counts) == len(set(counts))


def _wide(last: int, addresses: list[int], words: int = 1) -> DeviceMap:
    points = "".join(
        f"""
[[point]]
name = "p{address}"
address = {address}
words = {words}
symbol = "p"
group = "live"
codec = "{"u32" if words == 2 else "u16"}"
{'order = "hi-lo"' if words == 2 else ""}
help = "P."
doc = "d"
"""
        for address in addresses
    )
    return parse_map(
        f"""
model = "wide"
title = "Wide"
document = "none"
[functions]
3 = "registers"
[identity]
vendor = "Nobody"
product_prefixes = []
product_codes = []
[[extent]]
name = "ram"
first = 0
last = {last}
poll = "live"
doc = "d"
{points}""",
        "wide.toml",
    )


def test_a_long_range_becomes_blocks_of_at_most_125() -> None:
    blocks = poll_plan(_wide(400, list(range(0, 300, 2)), words=2))
    assert [(block.first, block.count) for block in blocks] == [(0, 124), (124, 125), (248, 52)]


def test_equal_blocks_are_made_unequal() -> None:
    blocks = poll_plan(_wide(300, [0, 99, 150, 249]))
    assert [(block.first, block.count) for block in blocks] == [(0, 100), (150, 101)]


def test_unequal_where_the_extent_ends() -> None:
    blocks = poll_plan(_wide(249, [0, 99, 150, 249]))
    assert [(block.first, block.count) for block in blocks] == [(0, 100), (149, 101)]


def test_equal_where_there_is_no_room() -> None:
    assert [block.count for block in poll_plan(_wide(249, list(range(250))))] == [125, 125]


@pytest.mark.parametrize("model", models())
def test_splitting_to_the_end_reads_every_item_once_and_tears_no_pair(model: str) -> None:
    device_map = load_map(model)

    def leaves(block: PlannedBlock) -> Iterator[PlannedBlock]:
        parts = split(block, device_map)
        if parts is None:
            yield block
            return
        for part in parts:
            yield from leaves(part)

    for block in poll_plan(device_map):
        ends = list(leaves(block))
        assert [address for end in ends for address in range(end.first, end.last + 1)] == list(
            range(block.first, block.last + 1)
        )
        assert {name for end in ends for name in _points_in(device_map, end)} == _points_in(device_map, block)
        assert {end.count for end in ends} <= {1, *(point.words for point in device_map.points)}
        assert {end.poll for end in ends} == {block.poll}


@given(first=st.integers(0, 81), count=st.integers(1, 82))
def test_halves_are_about_half_and_unequal(first: int, count: int) -> None:
    device_map = load_map("prostar-mppt")
    count = min(count, 82 - first)
    parts = split(PlannedBlock(REGISTERS, first, count, PollClass.LIVE), device_map)
    if parts is None:
        assert count == 1 or (count == 2 and not _splits_there(device_map, first))
        return
    one, two = parts
    assert one.count + two.count == count
    assert abs(one.count - two.count) <= 4
    if count > 4:
        assert one.count != two.count or _pairs_near(device_map, one.last)


def _splits_there(device_map: DeviceMap, first: int) -> bool:
    return not any(point.words == 2 and point.address == first for point in device_map.points)


def _pairs_near(device_map: DeviceMap, address: int) -> bool:
    return any(point.words == 2 and abs(point.address - address) <= 2 for point in device_map.points)


def test_one_register_cannot_be_split(small: DeviceMap) -> None:
    assert split(PlannedBlock(REGISTERS, 0, 1, PollClass.LIVE), small) is None


def test_one_pair_cannot_be_split(small: DeviceMap) -> None:
    assert split(PlannedBlock(REGISTERS, 2, 2, PollClass.LIVE), small) is None


def test_commands_alone_are_no_block(changed: Callable[..., str], small: DeviceMap) -> None:
    assert [block.space for block in poll_plan(small)] == [REGISTERS]
