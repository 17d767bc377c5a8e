from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.devices.codecs import CODECS, combine, decode, encode, separate
from gateway.devices.model import Space, WordOrder

HI_LO, LO_HI = WordOrder.HI_LO, WordOrder.LO_HI
REGISTER_CODECS = sorted(name for name, codec in CODECS.items() if codec.space is Space.REGISTERS)


def _of(codec: str, *words: int, order: WordOrder = HI_LO, scale: float = 1.0) -> float | None:
    return decode(codec, words, order, scale)


@pytest.mark.parametrize(
    ("codec", "words", "value"),
    [
        ("f16", (0x3C00,), 1.0),
        ("f16", (0x4B33,), 14.3984375),
        ("f16", (0xC000,), -2.0),
        ("f16", (0x0001,), 2**-24),
        ("f16", (0x8000,), 0.0),
        ("u16", (0xFFFF,), 65535),
        ("s16", (0xFFFF,), -1),
        ("s16", (0x8000,), -32768),
        ("u32", (0x0022, 0x13D8), 2_233_304),
        ("s32", (0xFFFF, 0x80F0), -32528),
        ("s8", (0x00F6,), -10),
        ("s8", (0xFFF6,), -10),
        ("s8", (0x007F,), 127),
        ("s8", (0x0080,), -128),
        ("s8", (0xFF80,), -128),
        ("bcd", (0x0013,), 13),
        ("bcd", (0x9999,), 9999),
        ("bcd", (0x1234, 0x5678), 12_345_678),
        ("enum", (99,), 99),
        ("bits", (0x1000, 0x0001), 0x1000_0001),
        ("flag", (0,), 0),
        ("flag", (0x8000,), 1),
        ("coil", (1,), 1),
        ("multiplier", (1,), 1.0),
        ("multiplier", (2,), 2.0),
        ("multiplier", (0x3C00,), 1.0),
        ("multiplier", (0x4000,), 2.0),
    ],
)
def test_decodes(codec: str, words: tuple[int, ...], value: float) -> None:
    assert _of(codec, *words) == value


@pytest.mark.parametrize(
    ("codec", "word"),
    [
        ("f16", 0x7C00),
        ("f16", 0xFC00),
        ("f16", 0x7E00),
        ("f16", 0x7C01),
        ("f16", 0xFFFF),
        ("multiplier", 0x7E00),
        ("bcd", 0x001A),
        ("bcd", 0xFFFF),
        ("s8", 0x0180),
        ("s8", 0xFF05),
    ],
)
def test_no_value_is_none(codec: str, word: int) -> None:
    assert _of(codec, word) is None


def test_low_word_first_swaps_the_pair() -> None:
    assert _of("u32", 0x13D8, 0x0022, order=LO_HI) == 2_233_304
    assert _of("u32", 0x13D8, 0x0022, order=HI_LO) == 0x13D8_0022


@pytest.mark.parametrize(("raw", "value"), [(3, 0.3), (7, 0.7), (65535, 6553.5)])
def test_tenths_print_as_tenths(raw: int, value: float) -> None:
    assert repr(_of("u16", raw, scale=0.1)) == repr(value)


def test_a_whole_scale_keeps_integers() -> None:
    value = _of("u16", 15, scale=60.0)
    assert value == 900
    assert isinstance(value, int)


def test_any_other_scale_is_a_factor() -> None:
    assert _of("s16", 0x0DB0, scale=2**-15) == 0x0DB0 / 2**15
    assert _of("u16", 100, scale=0.3) == pytest.approx(30.0)


@pytest.mark.parametrize("codec", REGISTER_CODECS)
@given(data=st.data())
def test_encoding_a_decoded_value_decodes_the_same(codec: str, data: st.DataObject) -> None:
    n_words = data.draw(st.sampled_from(sorted(CODECS[codec].words)))
    order = data.draw(st.sampled_from(WordOrder))
    scale = 1.0 if codec in {"flag", "multiplier", "f16"} else data.draw(st.sampled_from((1.0, 0.1, 60.0)))
    words = tuple(data.draw(st.lists(st.integers(0, 0xFFFF), min_size=n_words, max_size=n_words)))
    value = decode(codec, words, order, scale)
    if value is not None:
        again = encode(codec, value, n_words, order, scale)
        assert decode(codec, again, order, scale) == value
        if codec not in {"flag", "multiplier", "s8"}:
            assert again == words


@given(st.floats(-65504, 65504, width=16))
def test_every_half_float_survives(value: float) -> None:
    (word,) = encode("f16", value, 1, HI_LO, 1.0)
    assert _of("f16", word) == value


@given(st.floats(allow_nan=True, allow_infinity=True), st.sampled_from(sorted(CODECS)))
def test_encode_gives_words_or_refuses(value: float, codec: str) -> None:
    n_words = max(CODECS[codec].words)
    try:
        words = encode(codec, value, n_words, HI_LO, 1.0)
    except ValueError:
        return
    assert len(words) == n_words
    assert all(0 <= word <= 0xFFFF for word in words)


@pytest.mark.parametrize(
    ("codec", "value"),
    [
        ("f16", 70000.0),
        ("u16", -1),
        ("u16", 65536),
        ("u32", 2**32),
        ("s16", 32768),
        ("s8", 128),
        ("s8", -129),
        ("bcd", 10000),
        ("bcd", -1),
        ("flag", 2),
        ("enum", math.nan),
        ("bits", math.inf),
        ("multiplier", 1e-5),
    ],
)
def test_encode_never_wraps(codec: str, value: float) -> None:
    with pytest.raises(ValueError, match=r"outside|fit|not a number|too small"):
        encode(codec, value, 1 if codec != "u32" else 2, HI_LO, 1.0)


def test_not_a_number_is_how_a_missing_sensor_is_encoded() -> None:
    assert _of("f16", *encode("f16", math.nan, 1, HI_LO, 1.0)) is None


def test_encode_takes_the_nearest_step() -> None:
    assert encode("u16", 12.34, 1, HI_LO, 0.1) == (123,)
    assert encode("u16", 900, 1, HI_LO, 60.0) == (15,)
    assert encode("u32", 6553.8, 2, LO_HI, 0.1) == (2, 1)


@given(st.integers(0, 2**32 - 1), st.sampled_from(WordOrder))
def test_separate_undoes_combine(raw: int, order: WordOrder) -> None:
    assert combine(separate(raw, 2, order), order) == raw
