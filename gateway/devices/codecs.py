"""Codecs: how the words of a point become a value and back.

Rule 1: a codec knows nothing of a register; words, order and scale are arguments, the map has them. What the
        device itself says of its scaling are values of other points: `known` to those who read by a whole reading.
Rule 2: "no value" is `None`: NaN, infinity, a nibble that is no decimal digit. Never a substitute number.
Rule 3: decode then encode gives the same value; encode refuses with ValueError what it cannot say exactly
        enough (out of range, not finite), it never wraps or clips.
Rule 4: half floats are IEEE 754 binary16 by `struct`; the encoder printed in the ProStar document forgets the
        exponent's bias (14.4 V becomes 0x0F33) and must not be followed.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

from gateway.devices.model import Reading, Space, Value, WordOrder

_HALF = struct.Struct(">e")
_WORD = struct.Struct(">H")
_FIRST_NORMAL_HALF = 0x0400
_NOTHING: Mapping[str, Value] = MappingProxyType({})


@dataclass(frozen=True, slots=True)
class Codec:
    """One way to read an unsigned integer of `bits` bits.

    `decode(raw, bits)` gives the unscaled value or None; `encode(value, bits)` gives raw or raises ValueError.
    """

    name: str
    space: Space
    words: frozenset[int]  # how many words a point may have
    text: str  # for people
    decode: Callable[[int, int], Value | None]
    encode: Callable[[Value, int], int]

    @property
    def plain(self) -> bool:
        """Whether the unscaled value is the raw integer itself."""
        return self.decode is _unsigned_decode


def _half_decode(raw: int, _bits: int) -> float | None:
    value: float = _HALF.unpack(_WORD.pack(raw))[0]
    return value if math.isfinite(value) else None


def _half_encode(value: Value, _bits: int) -> int:
    try:
        raw: int = _WORD.unpack(_HALF.pack(value))[0]
    except (OverflowError, struct.error) as error:
        raise ValueError(f"{value!r} does not fit a half float") from error
    return raw


def _multiplier_decode(raw: int, bits: int) -> float | None:
    # A subnormal half (below 6.1e-5) is no multiplier, so such a word can only be a plain integer.
    return float(raw) if raw < _FIRST_NORMAL_HALF else _half_decode(raw, bits)


def _multiplier_encode(value: Value, bits: int) -> int:
    raw = _half_encode(value, bits)
    if 0 < raw < _FIRST_NORMAL_HALF:
        raise ValueError(f"{value!r} is too small for a multiplier")
    return raw


def _whole(value: Value) -> int:
    if not math.isfinite(value):
        raise ValueError(f"{value!r} is not a number a register can hold")
    return round(value)


def _ranged(value: Value, low: int, high: int) -> int:
    whole = _whole(value)
    if not low <= whole <= high:
        raise ValueError(f"{value!r} is outside {low}..{high}")
    return whole


def _unsigned_decode(raw: int, _bits: int) -> int:
    return raw


def _unsigned_encode(value: Value, bits: int) -> int:
    return _ranged(value, 0, (1 << bits) - 1)


def _signed_decode(raw: int, bits: int) -> int:
    return raw - (1 << bits) if raw >> (bits - 1) else raw


def _signed_encode(value: Value, bits: int) -> int:
    half = 1 << (bits - 1)
    return _ranged(value, -half, half - 1) & ((1 << bits) - 1)


def _byte_decode(raw: int, _bits: int) -> int | None:
    low = _signed_decode(raw & 0xFF, 8)
    return low if raw >> 8 in {0x00, (low & 0xFFFF) >> 8} else None


def _byte_encode(value: Value, bits: int) -> int:
    return _ranged(value, -128, 127) & ((1 << bits) - 1)


def _bcd_decode(raw: int, _bits: int) -> int | None:
    digits = f"{raw:X}"
    return int(digits) if digits.isdecimal() else None


def _bcd_encode(value: Value, bits: int) -> int:
    return int(str(_ranged(value, 0, 10 ** (bits // 4) - 1)), 16)


def _flag_decode(raw: int, _bits: int) -> int:
    return 1 if raw else 0


def _flag_encode(value: Value, _bits: int) -> int:
    return _ranged(value, 0, 1)


_ONE = frozenset({1})
_TWO = frozenset({2})
_ANY = frozenset({1, 2})


def _registers(
    name: str,
    words: frozenset[int],
    text: str,
    decode_raw: Callable[[int, int], Value | None],
    encode_raw: Callable[[Value, int], int],
) -> Codec:
    return Codec(name, Space.REGISTERS, words, text, decode_raw, encode_raw)


CODECS: Mapping[str, Codec] = MappingProxyType(
    {
        codec.name: codec
        for codec in (
            _registers("f16", _ONE, "half-precision float", _half_decode, _half_encode),
            _registers("u16", _ONE, "unsigned 16-bit", _unsigned_decode, _unsigned_encode),
            _registers("u32", _TWO, "unsigned 32-bit pair", _unsigned_decode, _unsigned_encode),
            _registers("s16", _ONE, "signed 16-bit", _signed_decode, _signed_encode),
            _registers("s32", _TWO, "signed 32-bit pair", _signed_decode, _signed_encode),
            _registers("s8", _ONE, "signed 8-bit, sign extended or not", _byte_decode, _byte_encode),
            _registers("bcd", _ANY, "binary coded decimal", _bcd_decode, _bcd_encode),
            _registers("enum", _ONE, "enumeration", _unsigned_decode, _unsigned_encode),
            _registers("bits", _ANY, "bit field", _unsigned_decode, _unsigned_encode),
            _registers("flag", _ONE, "zero or not zero", _flag_decode, _flag_encode),
            _registers("multiplier", _ONE, "half float or small integer", _multiplier_decode, _multiplier_encode),
            Codec("coil", Space.COILS, _ONE, "coil", _flag_decode, _flag_encode),
        )
    }
)


def combine(words: Sequence[int], order: WordOrder) -> int:
    """Join 16-bit words, given in address order, into one unsigned integer."""
    raw = 0
    for word in words if order is WordOrder.HI_LO else reversed(words):
        raw = raw << 16 | word
    return raw


def separate(raw: int, n_words: int, order: WordOrder) -> tuple[int, ...]:
    """Cut an unsigned integer into 16-bit words in address order; the inverse of `combine`."""
    words = tuple(raw >> shift & 0xFFFF for shift in range(0, 16 * n_words, 16))
    return words if order is WordOrder.LO_HI else words[::-1]


def _divisor(scale: float) -> int | None:
    """N when the scale is 1/N, so that 3 × 0.1 can be computed as 3 / 10 and print as 0.3."""
    if not 0 < scale < 1:
        return None
    nearest = round(1 / scale)
    return nearest if math.isclose(nearest * scale, 1, rel_tol=1e-12) else None


def scaler(scale: float) -> Callable[[Value], Value] | None:
    """The function raw → raw × scale, exact for 1/N and whole scales; None when there is nothing to do."""
    if scale == 1:
        return None
    divisor = _divisor(scale)
    if divisor is not None:
        return lambda raw: raw / divisor
    factor: Value = int(scale) if scale == int(scale) else scale
    return lambda raw: raw * factor


def decode(codec: str, words: Sequence[int], order: WordOrder, scale: float) -> Value | None:
    """Decode words (address order; one 0/1 for a coil) to a value in the point's unit, None for "no value"."""
    raw = combine(words, order)
    value = CODECS[codec].decode(raw, 16 * len(words))
    if value is None:
        return None
    scaled = scaler(scale)
    return value if scaled is None else scaled(value)


def encode(codec: str, value: Value, n_words: int, order: WordOrder, scale: float) -> tuple[int, ...]:
    """Encode a value in the point's unit to words in address order, to the nearest step; ValueError if it cannot be."""
    divisor = _divisor(scale)
    unscaled = value * divisor if divisor is not None else value if scale == 1 else value / scale
    return separate(CODECS[codec].encode(unscaled, 16 * n_words), n_words, order)


def read_words(reading: Reading, words: Sequence[int], known: Mapping[str, Value] = _NOTHING) -> Value | None:
    """The value of words in address order (one 0/1 for a coil) by a reading; None for "no value".

    `known` has the values of the points that tell the scaling; while one of them is not known there is no value.
    """
    if combine(words, reading.order) in reading.absent:
        return None
    value = decode(reading.codec, words, reading.order, reading.scale)
    factor = product_of(reading.factors, known)
    return None if value is None or factor is None else value if not reading.factors else value * factor


def write_words(reading: Reading, value: Value, n_words: int, known: Mapping[str, Value] = _NOTHING) -> tuple[int, ...]:
    """The inverse of `read_words`, to the nearest step; ValueError if it cannot be said or the scaling is not known."""
    factor = product_of(reading.factors, known)
    if not factor:
        raise ValueError(f"the scaling by {' and '.join(reading.factors)} is not known")
    return encode(reading.codec, value / factor if reading.factors else value, n_words, reading.order, reading.scale)


def product_of(factors: Sequence[str], known: Mapping[str, Value]) -> Value | None:
    """The product of the values of these points, 1 of none; None while one of them is not known."""
    product: Value = 1
    for name in factors:
        factor = known.get(name)
        if factor is None:
            return None
        product *= factor
    return product
