from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.devices.decode import Decoder
from gateway.devices.forms import parse_map
from gateway.devices.model import DeviceMap, Space
from gateway.devices.schema import load_map
from gateway.errors import MapError

BLOCK = struct.pack(">8H", 0x4AA0, 0, 0x0001, 0x0002, 1, 0x8001, 0x4D00, 0)
WHOLE = {"battery_voltage": 13.25, "energy_total": 6553.8, "charge_state": 1, "faults": 0x8001, "limit": 20.0}


def test_decodes_a_block(small: DeviceMap) -> None:
    assert Decoder(small).decode(Space.REGISTERS, 0, BLOCK) == WHOLE


@given(first=st.integers(0, 8), count=st.integers(0, 8))
def test_decodes_only_points_that_lie_wholly_inside(small: DeviceMap, first: int, count: int) -> None:
    count = min(count, 8 - first)
    values = Decoder(small).decode(Space.REGISTERS, first, BLOCK[2 * first : 2 * (first + count)])
    inside = {
        point.name
        for point in small.points
        if point.space is Space.REGISTERS and point.address >= first and point.address + point.words <= first + count
    }
    assert values == {name: WHOLE[name] for name in inside}


@pytest.mark.parametrize(("first", "count"), [(0, 3), (3, 2)])
def test_never_decodes_half_a_pair(small: DeviceMap, first: int, count: int) -> None:
    assert "energy_total" not in Decoder(small).decode(Space.REGISTERS, first, BLOCK[2 * first : 2 * (first + count)])


def test_takes_the_reading_chosen_for_the_device(small: DeviceMap) -> None:
    values = Decoder(small, {"energy_total": "swapped"}).decode(Space.REGISTERS, 0, BLOCK)
    assert values["energy_total"] == 13107.3


def test_a_broken_digit_in_a_swapped_pair_is_no_value(small_text: str) -> None:
    swapped_bcd = small_text.replace('codec = "u32"\norder = "lo-hi"', 'codec = "bcd"\norder = "lo-hi"')
    decoder = Decoder(parse_map(swapped_bcd, "small.toml"), {"energy_total": "swapped"})
    assert decoder.decode(Space.REGISTERS, 2, b"\x56\x78\x12\x34") == {"energy_total": 1_234_567.8}
    assert decoder.decode(Space.REGISTERS, 2, b"\x56\x78\x12\x3a") == {}


def test_unknown_readings_are_all_named(small: DeviceMap) -> None:
    with pytest.raises(MapError) as caught:
        Decoder(small, {"energy_total": "f16", "battery_volts": "f16"})
    assert str(caught.value).splitlines() == [
        "small: point energy_total has no reading 'f16'; known: document, swapped",
        "small: no point 'battery_volts' to read as 'f16'",
    ]


@pytest.mark.parametrize("half", [0x7E00, 0x7C00, 0xFC00, 0xFFFF])
def test_leaves_out_what_has_no_value_and_does_not_count_it(small: DeviceMap, half: int) -> None:
    decoder = Decoder(small)
    block = struct.pack(">H", half) + BLOCK[2:12] + struct.pack(">H", half)
    assert decoder.decode(Space.REGISTERS, 0, block).keys() == WHOLE.keys() - {"battery_voltage", "limit"}
    assert decoder.implausible == 0


def test_withholds_and_counts_what_cannot_be(small: DeviceMap) -> None:
    decoder = Decoder(small)
    block = BLOCK[:12] + struct.pack(">e", 101.0)
    for count in (1, 2):
        assert "limit" not in decoder.decode(Space.REGISTERS, 0, block)
        assert decoder.implausible == count


def test_withholds_a_wrapped_counter() -> None:
    decoder = Decoder(load_map("prostar-mppt"))
    wrapped = struct.pack(">I", 4_294_934_512)
    values = decoder.decode(Space.REGISTERS, 0x28, wrapped)
    assert values == {}
    assert decoder.implausible == 1


def test_never_decodes_a_command(small: DeviceMap) -> None:
    assert Decoder(small).decode(Space.COILS, 0, b"\x01", 1) == {}


def test_decodes_coils_bit_0_first() -> None:
    decoder = Decoder(load_map("prostar-mppt"))
    names = ["equalize_triggered", "load_disconnect_forced", "charge_disconnect_forced"]
    for packed in range(8):
        values = decoder.decode(Space.COILS, 0, bytes([packed]), 3)
        assert [values[name] for name in names] == [packed & 1, packed >> 1 & 1, packed >> 2]
    assert decoder.decode(Space.COILS, 0, b"\x07", 2).keys() == set(names[:2])
    assert decoder.decode(Space.COILS, 1, b"\x02") == {names[1]: 0, names[2]: 1}


def test_half_a_word_is_refused(small: DeviceMap) -> None:
    with pytest.raises(ValueError, match="15 bytes are not whole registers"):
        Decoder(small).decode(Space.REGISTERS, 0, BLOCK[:-1])


def test_forgets_block_forms_rather_than_grow(small: DeviceMap) -> None:
    decoder = Decoder(small)
    for first in range(1000):
        decoder.decode(Space.REGISTERS, first, b"\0\0")
    assert len(decoder._forms) <= 64
    assert decoder.decode(Space.REGISTERS, 0, BLOCK) == WHOLE


@given(first=st.integers(0, 0xFFFF), data=st.binary(max_size=250))
def test_any_words_anywhere_decode(first: int, data: bytes) -> None:
    data = data[: len(data) // 2 * 2]
    decoder = Decoder(load_map("prostar-mppt"))
    for value in decoder.decode(Space.REGISTERS, first, data).values():
        assert value - value == 0, "finite"
