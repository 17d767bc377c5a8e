"""From the bytes of one block to the values of its points; runs at every poll.

Rule 1: a point is decoded only when all its words lie in the block, so a 32-bit pair never mixes two reads.
Rule 2: "no value" (NaN, infinity, a broken digit) is left out, it has no substitute.
Rule 3: a value outside the point's plausible bounds is left out too, and counted in `implausible`.
Rule 4: commands are never decoded.
Rule 5: a point that the device scales has no value until the points that tell the scaling have one; of the same
        block if they lie in it, else as the caller knows them.

What to do with a block is worked out once per block form and kept, for all devices of a model that are read alike:
three `struct` formats, one for the half floats, one for what the device scales and one for everything else, each
naming exactly its points and skipping the bytes between.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from struct import Struct
from types import MappingProxyType

from gateway.devices.codecs import CODECS, product_of, scaler
from gateway.devices.model import DeviceMap, Kind, Point, Reading, Space, Value, WordOrder
from gateway.devices.texts import decode_text
from gateway.errors import MapError

_HALF_BOUNDS = (-65504.0, 65504.0)  # the finite halves: infinity is outside, NaN compares with nothing
_NO_BOUNDS = (-math.inf, math.inf)
_MAX_FORMS = 64  # a device is polled in a handful of block forms; a caller with more only loses the cache
_MAX_KINDS = 32  # of devices, as they are read: models, and readings that were chosen

_Convert = Callable[[int], Value | None]
_NOTHING: Mapping[str, Value] = MappingProxyType({})


@dataclass(frozen=True, slots=True)
class _Form:
    """How to decode one block form; halves and others are (name, low, high) beside what the format unpacks."""

    halves: Struct
    half_points: tuple[tuple[str, float, float], ...]
    others: Struct
    other_points: tuple[tuple[str, _Convert | None, float, float], ...]
    scaled: Struct
    scaled_points: tuple[tuple[str, _Convert | None, float, float, tuple[str, ...]], ...]
    texts: tuple[tuple[str, slice, Reading], ...]
    names: frozenset[str]  # of all points that it decodes


@dataclass(frozen=True, slots=True)
class _Bound:
    """A point with the reading the device uses."""

    point: Point
    reading: Reading

    @property
    def is_half(self) -> bool:
        plain = self.reading.scale == 1 and not self.reading.factors and not self.reading.absent
        return self.reading.codec == "f16" and plain

    @property
    def bounds(self) -> tuple[float, float]:
        return self.point.plausible or (_HALF_BOUNDS if self.is_half else _NO_BOUNDS)

    def slice_from(self, first: int) -> slice:
        """Its bytes in a block that begins at `first`."""
        start = 2 * (self.point.address - first)
        return slice(start, start + 2 * self.point.words)


class Decoder:
    """Decodes the blocks of one device with the readings chosen for it.

    `readings` maps point names to reading names; points not in it use the document's. MapError names every
    entry that the map does not know. `implausible` counts the values withheld since the decoder was made;
    `factors` are the points that tell the scaling of others.
    """

    def __init__(self, device_map: DeviceMap, readings: Mapping[str, str] | None = None) -> None:
        self.implausible = 0
        self._forms = _forms(device_map, dict(readings or {}))
        self.factors = self._forms.factors

    def decode(
        self, space: Space, first: int, data: bytes, count: int | None = None, known: Mapping[str, Value] = _NOTHING
    ) -> dict[str, Value]:
        """Values of the points that lie wholly in a block.

        `data` is big-endian words, or coils packed as in a reply (bit 0 first); `count` is the number of coils
        asked for, without it all bits of `data` are taken. `known` has values of `factors` that other blocks held.
        ValueError when registers come with half a word.
        """
        if space is Space.COILS:
            count = min(8 * len(data), 8 * len(data) if count is None else count)
            data = b"".join((b"\x00\x01" if data[n >> 3] >> (n & 7) & 1 else b"\x00\x00") for n in range(count))
        form = self._forms.of(space, first, len(data))
        values: dict[str, Value] = {}
        for (name, low, high), half in zip(form.half_points, form.halves.unpack(data), strict=True):
            if low <= half <= high:
                values[name] = half
            elif math.isfinite(half):
                self.implausible += 1
        for (name, convert, low, high), raw in zip(form.other_points, form.others.unpack(data), strict=True):
            value = raw if convert is None else convert(raw)
            if value is None:
                continue
            if low <= value <= high:
                values[name] = value
            else:
                self.implausible += 1
        if form.scaled_points:
            self._scale(form, data, values, known)
        return values

    def texts(self, space: Space, first: int, data: bytes) -> dict[str, str]:
        """Texts of the points that lie wholly in a block of registers; there are none in coils."""
        if space is Space.COILS:
            return {}
        found = (
            (name, decode_text(reading.codec, data[place], reading.order))
            for name, place, reading in self._forms.of(space, first, len(data)).texts
        )
        return {name: text for name, text in found if text is not None}

    def names(self, space: Space, first: int, count: int) -> frozenset[str]:
        """The points that lie wholly in a block of `count` registers or coils, with a value or without."""
        return self._forms.of(space, first, 2 * count).names

    def _scale(self, form: _Form, data: bytes, values: dict[str, Value], known: Mapping[str, Value]) -> None:
        """Rule 5; the points that tell the scaling are in `values` by now if this block holds them."""
        here = {name: value for name in self.factors if (value := values.get(name, known.get(name))) is not None}
        for (name, convert, low, high, factors), raw in zip(form.scaled_points, form.scaled.unpack(data), strict=True):
            unscaled = raw if convert is None else convert(raw)
            factor = product_of(factors, here)
            if unscaled is None or factor is None:
                continue
            value = unscaled * factor
            if low <= value <= high:
                values[name] = value
            else:
                self.implausible += 1


class _Forms:
    """The forms of all blocks of devices that are read alike."""

    def __init__(self, device_map: DeviceMap, readings: Mapping[str, str]) -> None:
        self.map = device_map
        self._points = _bind(device_map, dict(readings))
        self.factors = frozenset(name for bound in self._points for name in bound.reading.factors)
        self._kept: dict[tuple[Space, int, int], _Form] = {}

    def __len__(self) -> int:
        return len(self._kept)

    def of(self, space: Space, first: int, size: int) -> _Form:
        """The form of a block of `size` bytes of registers, or of twice as many bytes as coils."""
        key = (space, first, size)
        form = self._kept.get(key)
        return self._remember(key) if form is None else form

    def _remember(self, key: tuple[Space, int, int]) -> _Form:
        if len(self._kept) >= _MAX_FORMS:
            self._kept.clear()
        space, first, size = key
        if size % 2:
            raise ValueError(f"{size} bytes are not whole registers")
        last = first + size // 2 - 1
        inside = [
            bound
            for bound in self._points
            if bound.point.space is space
            and first <= bound.point.address
            and bound.point.address + bound.point.words - 1 <= last
        ]
        texts = [bound for bound in inside if bound.point.kind is Kind.TEXT]
        halves = [bound for bound in inside if bound.is_half]
        scaled = [bound for bound in inside if bound.reading.factors]
        others = [bound for bound in inside if bound not in texts and bound not in halves and bound not in scaled]
        form = _Form(
            _format(halves, first, size, {1: "e"}),
            tuple((bound.point.name, *bound.bounds) for bound in halves),
            _format(others, first, size, {1: "H", 2: "I"}),
            tuple((bound.point.name, _converter(bound), *bound.bounds) for bound in others),
            _format(scaled, first, size, {1: "H", 2: "I"}),
            tuple((bound.point.name, _converter(bound), *bound.bounds, bound.reading.factors) for bound in scaled),
            tuple((bound.point.name, bound.slice_from(first), bound.reading) for bound in texts),
            frozenset(bound.point.name for bound in inside),
        )
        self._kept[key] = form
        return form


_KINDS: dict[tuple[int, tuple[tuple[str, str], ...]], _Forms] = {}


def _forms(device_map: DeviceMap, readings: Mapping[str, str]) -> _Forms:
    """Those of a map and readings; the same ones for all who ask, for they depend on nothing else."""
    key = (id(device_map), tuple(sorted(readings.items())))
    known = _KINDS.get(key)
    if known is None or known.map is not device_map:
        if len(_KINDS) >= _MAX_KINDS:
            _KINDS.clear()
        known = _KINDS[key] = _Forms(device_map, readings)
    return known


def _bind(device_map: DeviceMap, readings: dict[str, str]) -> tuple[_Bound, ...]:
    bound = []
    problems = []
    for point in sorted(device_map.points, key=lambda point: point.address):
        name = readings.pop(point.name, None)
        try:
            reading = point.reading(name)
        except KeyError:
            known = ", ".join(reading.name for reading in point.readings)
            problems.append(f"point {point.name} has no reading {name!r}; known: {known}")
            continue
        if point.polled:
            bound.append(_Bound(point, reading))
    problems += [f"no point {name!r} to read as {reading!r}" for name, reading in readings.items()]
    if problems:
        raise MapError("\n".join(f"{device_map.model}: {problem}" for problem in problems))
    return tuple(bound)


def _format(bounds: Sequence[_Bound], first: int, size: int, letters: Mapping[int, str]) -> Struct:
    """A big-endian format of `size` bytes with one letter a point and padding everywhere else."""
    text = ">"
    at = 0
    for bound in bounds:
        start = 2 * (bound.point.address - first)
        text += f"{start - at}x{letters[bound.point.words]}"
        at = start + 2 * bound.point.words
    return Struct(f"{text}{size - at}x")


def _converter(bound: _Bound) -> _Convert | None:
    """The function from the unsigned integer, high word first, to the value; None when they are the same."""
    codec = CODECS[bound.reading.codec]
    bits = 16 * bound.point.words
    swap = bound.point.words == 2 and bound.reading.order is WordOrder.LO_HI
    scaled = scaler(bound.reading.scale)
    absent = bound.reading.absent
    if codec.plain and not absent:
        if swap:
            return lambda raw: _in_order(raw, scaled)
        return scaled

    def convert(raw: int) -> Value | None:
        if swap:
            raw = _swapped(raw)
        value = None if raw in absent else codec.decode(raw, bits)
        return value if value is None or scaled is None else scaled(value)

    return convert


def _swapped(raw: int) -> int:
    return (raw & 0xFFFF) << 16 | raw >> 16


def _in_order(raw: int, scaled: Callable[[Value], Value] | None) -> Value:
    value = _swapped(raw)
    return value if scaled is None else scaled(value)
