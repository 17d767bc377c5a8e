"""Values that the device itself scales, and numbers that stand for none."""

from __future__ import annotations

import struct
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.devices.codecs import read_words, write_words
from gateway.devices.decode import Decoder
from gateway.devices.forms import parse_map
from gateway.devices.model import Reading, Released, Space, WordOrder
from gateway.errors import MapError

Change = Callable[..., str]

SCALED = """
[[point]]
name = "full_scale"
address = 0x000A
words = 2
symbol = "pu"
group = "settings"
unit = "V"
codec = "u32"
order = "hi-lo"
shift = 16
plausible = [1, 500]
help = "Scale."
doc = "RAM"

[[point]]
name = "array_voltage"
address = 0x000C
symbol = "va"
group = "live"
unit = "V"
codec = "s16"
shift = 15
scaled_by = ["full_scale"]
plausible = [-10, 250]
help = "Array."
doc = "RAM"

[[point]]
name = "sensor"
address = 0x000D
symbol = "t"
group = "live"
unit = "°C"
codec = "s8"
absent = [0x0080, 0xFF80]
help = "Sensor."
doc = "RAM"

[log]"""


@pytest.fixture
def scaled(changed: Change) -> Decoder:
    return Decoder(parse_map(changed(("[log]", SCALED)), "scaled.toml"))


def block(*words: int) -> bytes:
    return struct.pack(f">{len(words)}H", *words)


def test_a_value_is_scaled_by_what_its_own_block_tells(scaled: Decoder) -> None:
    values = scaled.decode(Space.REGISTERS, 0x000A, block(0x007B, 0xE041, 0x0DB0))
    assert values["full_scale"] == 123 + 0xE041 / 65536
    assert values["array_voltage"] == pytest.approx(13.25, abs=0.005)


def test_own_block_goes_before_what_the_caller_knows(scaled: Decoder) -> None:
    values = scaled.decode(Space.REGISTERS, 0x000A, block(100, 0, 0x4000), known={"full_scale": 50.0})
    assert values["array_voltage"] == 50.0


def test_without_its_scaling_a_point_has_no_value(scaled: Decoder) -> None:
    assert scaled.factors == {"full_scale"}
    assert scaled.decode(Space.REGISTERS, 0x000C, block(0x4000)) == {}
    assert scaled.decode(Space.REGISTERS, 0x000C, block(0x4000), known={"full_scale": 100.0}) == {"array_voltage": 50.0}


def test_an_implausible_scaling_scales_nothing(scaled: Decoder) -> None:
    assert scaled.decode(Space.REGISTERS, 0x000A, block(0, 0, 0x4000)) == {}
    assert scaled.implausible == 1


def test_bounds_are_those_of_the_scaled_value(scaled: Decoder) -> None:
    known = {"full_scale": 400.0}
    assert scaled.decode(Space.REGISTERS, 0x000C, block(0x7FFF), known=known) == {}
    assert scaled.implausible == 1
    assert scaled.decode(Space.REGISTERS, 0x000C, block(0xFFFF), known=known)["array_voltage"] == -400 / 32768


@pytest.mark.parametrize(
    ("word", "expected"),
    [(0x0080, None), (0xFF80, None), (0x007F, 127), (0x0081, -127), (0xFF81, -127), (0x1234, None)],
)
def test_a_number_may_stand_for_no_value(scaled: Decoder, word: int, expected: int | None) -> None:
    assert scaled.decode(Space.REGISTERS, 0x000D, block(word)).get("sensor") == expected


@given(raw=st.integers(0, 0xFFFF), factor=st.floats(1, 500))
def test_reading_and_writing_are_inverse(raw: int, factor: float) -> None:
    reading = Reading("document", "s16", WordOrder.HI_LO, 2**-15, "", ("full_scale",), frozenset({0x8000}))
    value = read_words(reading, (raw,), {"full_scale": factor})
    assert (value is None) == (raw == 0x8000)
    if value is not None:
        assert write_words(reading, value, 1, {"full_scale": factor}) == (raw,)
    assert read_words(reading, (raw,), {}) is None
    with pytest.raises(ValueError, match="full_scale is not known"):
        write_words(reading, 1.0, 1, {})


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        (
            'scaled_by = ["full_scale"]',
            'scaled_by = ["full"]',
            "array_voltage: reading document: scaled_by: no point full",
        ),
        ('scaled_by = ["full_scale"]', 'scaled_by = ["charge_state"]', "scaled_by: charge_state is no polled number"),
        ('scaled_by = ["full_scale"]', 'scaled_by = ["array_voltage"]', "array_voltage is itself scaled by a point"),
        ("absent = [0x0080, 0xFF80]", "absent = [-1]", "point sensor: absent"),
        ("shift = 15", "shift = 33", "point array_voltage: shift"),
        ('name = "sensor"', 'name = "sensor"\nreleased = "negative"', "released is for what must be rewritten"),
        (
            'codec = "s8"\nabsent',
            'codec = "ascii"\nabsent',
            "point sensor: reading document: a 16-bit point needs order",
        ),
    ],
)
def test_what_makes_no_sense_is_named(changed: Change, old: str, new: str, problem: str) -> None:
    assert SCALED.count(old) == 1
    with pytest.raises(MapError) as raised:
        parse_map(changed(("[log]", SCALED.replace(old, new))), "scaled.toml")
    assert problem in str(raised.value)


TEXT = """
[[point]]
name = "label"
address = 0x000A
words = 4
symbol = "l"
group = "settings"
codec = "ascii"
order = "lo-hi"
help = "Label."
doc = "RAM"
mib = { column = 2, syntax = "Text" }
metric = "morningstar_label_info"

[log]"""


def test_texts_are_read_apart_from_the_values(changed: Change) -> None:
    decoder = Decoder(parse_map(changed(("[log]", TEXT)), "text.toml"))
    data = block(0x3130, 0x3332, 0x0000, 0x0000)
    assert decoder.decode(Space.REGISTERS, 0x000A, data) == {}
    assert decoder.texts(Space.REGISTERS, 0x000A, data) == {"label": "0123"}
    assert decoder.texts(Space.REGISTERS, 0x000A, data[:6]) == {}, "a text that lies in two blocks is not put together"
    assert decoder.texts(Space.REGISTERS, 0x000A, bytes(8)) == {}
    assert decoder.texts(Space.COILS, 0, b"\xff") == {}


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ('codec = "ascii"', 'codec = "mac"', "codec mac does not fit 4 word(s)"),
        ('syntax = "Text"', 'syntax = "Unsigned32"', "syntax Unsigned32 does not fit the point"),
        ("morningstar_label_info", "morningstar_label", "must be morningstar_label_info"),
        ('order = "lo-hi"', 'order = "lo-hi"\nscale = 2', "a text has no scale"),
        ('order = "lo-hi"', 'order = "lo-hi"\nplausible = [0, 1]', "a text has no unit and no plausible bounds"),
        ('order = "lo-hi"', 'order = "lo-hi"\naccess = "write"', "cannot be written"),
        ('symbol = "l"', 'symbol = "l"\nspace = "coils"', "codec ascii is for registers"),
        ("words = 4", "words = 9", "point label: words"),
        (
            "\n[log]",
            '[[point.alternative]]\nname = "number"\ncodec = "u16"\nevidence = "no"\n[log]',
            "reading number: unknown codec 'u16'; known: ascii",
        ),
    ],
)
def test_a_text_that_makes_no_sense_is_named(changed: Change, old: str, new: str, problem: str) -> None:
    assert TEXT.count(old) == 1
    with pytest.raises(MapError) as raised:
        parse_map(changed(("[log]", TEXT.replace(old, new))), "text.toml")
    assert problem in str(raised.value)


@pytest.mark.parametrize(
    ("released", "word", "held", "after"),
    [
        (Released.BY_ZERO, 0x0000, True, False),
        (Released.BY_ZERO, 0x4B00, False, True),
        (Released.BY_ZERO, 0x8000, False, True),
        (Released.BY_NEGATIVE, 0x0DB0, False, True),
        (Released.BY_NEGATIVE, 0xFFF0, True, False),
        (Released.BY_NEGATIVE, 0xFFF0, False, False),
        (Released.BY_NEGATIVE, 0x0000, True, True),
        (Released.BY_NEGATIVE, 0x0000, False, False),
    ],
)
def test_what_takes_and_what_ends_control(released: Released, word: int, held: bool, after: bool) -> None:
    assert released.held_by(word, held=held) is after
