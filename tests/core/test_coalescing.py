"""Joined reads: cheaper on the wire, inside the map, and each waiter gets exactly its own part."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.core.budget import read_s
from gateway.core.coalescing import join, part
from gateway.core.requests import ClientRead, Lane, Span
from gateway.core.settings import LineSettings
from gateway.core.site import Device
from gateway.devices.model import Space
from gateway.devices.plan import limit
from gateway.devices.schema import load_map
from gateway.modbus.pdu import ReadRequest

MAP = load_map("prostar-mppt")
DEVICE = Device("array-1", 1, 1, MAP)
TIMING = LineSettings(name="line", index=1, port="virtual").timing()


def cost(space: Space, count: int) -> float:
    return read_s(TIMING, space, count)


def reading(first: int, count: int, function: int = 3, *, alone: bool = False) -> ClientRead:
    request = ReadRequest(function, first, count)
    return ClientRead(DEVICE, request.encode(), Lane.CLIENT, Span.of(DEVICE, request), 0.0, alone=alone)


def joined(head: ClientRead, *others: ClientRead, most: int = 125) -> tuple[int, int, int]:
    span, reads = join(head, others, cost=cost, mapped=MAP.covers, most=lambda space: min(most, limit(space)))
    assert span is not None
    return span.first, span.count, len(reads)


def test_overlapping_and_touching_reads_are_joined() -> None:
    assert joined(reading(0x10, 8), reading(0x14, 8)) == (0x10, 12, 2)
    assert joined(reading(0x10, 4), reading(0x14, 4)) == (0x10, 8, 2)


def test_a_read_inside_another_is_free() -> None:
    assert joined(reading(0, 82), reading(0x12, 1)) == (0, 82, 2)


def test_functions_03_and_04_read_the_same_registers_and_are_joined() -> None:
    assert joined(reading(0x10, 2, function=3), reading(0x12, 2, function=4)) == (0x10, 4, 2)


def test_registers_and_coils_are_not() -> None:
    assert joined(reading(0, 2, function=3), reading(0, 2, function=1)) == (0, 2, 1)


def test_the_widest_hole_that_is_bridged_is_where_the_wire_breaks_even() -> None:
    """A second request costs 8 + 5 characters, two gaps and a turnaround; a register in a hole costs two characters."""
    second_s = cost(Space.REGISTERS, 1) + cost(Space.REGISTERS, 1) - cost(Space.REGISTERS, 2)
    widest = int(second_s / (2 * TIMING.char_s) - 1e-9)
    assert 10 <= widest <= 20
    near, far = reading(0x11 + widest, 1), reading(0x11 + widest + 1, 1)
    assert joined(reading(0x10, 1), near) == (0x10, widest + 2, 2)
    assert joined(reading(0x10, 1), far) == (0x10, 1, 1)


def test_a_hole_outside_of_the_map_is_never_bridged() -> None:
    assert joined(reading(0x50, 2), reading(0x54, 2)) == (0x50, 2, 1)  # the RAM ends at 0x0051


def test_no_longer_than_the_protocol_or_the_device_allows() -> None:
    assert joined(reading(0x8000, 100), reading(0x8064, 30)) == (0x8000, 100, 1)
    assert joined(reading(0x10, 20), reading(0x24, 20), most=30) == (0x10, 20, 1)


def test_what_was_refused_together_stays_apart() -> None:
    assert joined(reading(0x10, 2, alone=True), reading(0x12, 2)) == (0x10, 2, 1)
    assert joined(reading(0x10, 2), reading(0x12, 2, alone=True)) == (0x10, 2, 1)


def test_a_union_that_grew_reaches_further() -> None:
    reads = [reading(0x10, 1), reading(0x18, 1), reading(0x20, 1), reading(0x28, 1)]
    assert joined(reads[0], *reads[1:]) == (0x10, 0x19, 4)


@given(st.lists(st.tuples(st.integers(0, 81), st.integers(1, 40), st.sampled_from((3, 4))), min_size=1, max_size=8))
def test_a_joined_read_is_cheaper_and_gives_each_waiter_its_own_registers(asked: list[tuple[int, int, int]]) -> None:
    reads = [reading(first, min(count, 82 - first), function) for first, count, function in asked]
    span, taken = join(reads[0], reads, cost=cost, mapped=MAP.covers, most=limit)
    assert span is not None
    assert taken[0] is reads[0]
    assert cost(span.space, span.count) <= sum(cost(Space.REGISTERS, r.span.count) for r in taken if r.span) + 1e-9
    words = range(1000 + span.first, 1000 + span.first + span.count)
    reply = struct.pack(f">BB{span.count}H", span.function, 2 * span.count, *words)
    for read in taken:
        wanted = read.span
        assert wanted is not None
        own = struct.pack(
            f">BB{wanted.count}H",
            wanted.function,
            2 * wanted.count,
            *range(1000 + wanted.first, 1000 + wanted.first + wanted.count),
        )
        assert part(reply, span, wanted) == own


@given(st.integers(0, 255), st.integers(1, 256), st.data())
def test_the_part_of_a_coil_read_is_the_same_bits(first: int, count: int, data: st.DataObject) -> None:
    count = min(count, 256 - first)
    bits = data.draw(st.lists(st.booleans(), min_size=256, max_size=256))
    packed = sum(bit << i for i, bit in enumerate(bits)).to_bytes(32, "little")
    whole = Span(Space.COILS, 1, 0, 256)
    reply = part(bytes((1, 32)) + packed, whole, Span(Space.COILS, 2, first, count))
    assert reply[:2] == bytes((2, (count + 7) // 8))
    got = int.from_bytes(reply[2:], "little")
    assert [got >> i & 1 for i in range(count)] == [int(bit) for bit in bits[first : first + count]]
    assert got >> count == 0


@pytest.mark.parametrize("count", [1, 82, 125])
def test_the_whole_is_its_own_part(count: int) -> None:
    reply = bytes((3, 2 * count)) + bytes(range(250))[: 2 * count]
    span = Span(Space.REGISTERS, 3, 0, count)
    assert part(reply, span, span) == reply
