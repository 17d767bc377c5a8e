"""Whether a value may be written to a point: the limits that stand in the map.

Rule 1: what would not read back as a value is refused: NaN and infinity of a half float, digits that are none, and
        any number while the device has not told how it is scaled.
Rule 2: `minimum` and `maximum` of the map hold, and so does `plausible`: what the gateway would not believe when it
        reads it, it does not write. Both are in the point's unit, by the reading that the device is read with.
Rule 3: an enumeration takes its own numbers only, a bit field its own bits, a coil that can only be set a 1.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from gateway.devices.codecs import read_words
from gateway.devices.model import Access, DeviceMap, Point, Value
from gateway.errors import IllegalDataValue

_NOTHING: Mapping[str, Value] = MappingProxyType({})


def check_value(
    point: Point, word: int, device_map: DeviceMap, reading: str | None = None, known: Mapping[str, Value] = _NOTHING
) -> Value:
    """The value that `word` (a coil: 0 or 1) stands for; raises IllegalDataValue when it may not be written.

    `known` are the device's values, for those that tell its scaling.
    """
    value = read_words(point.reading(reading), (word,), known)
    if value is None:
        raise IllegalDataValue(f"{point.name}: 0x{word:04X} is no value")
    for low, high in ((point.minimum, point.maximum), point.plausible or (None, None)):
        if (low is not None and value < low) or (high is not None and value > high):
            raise IllegalDataValue(f"{point.name}: {value:g} is outside its limits")
    if point.enumeration is not None and value not in {
        entry.number for entry in device_map.enumerations[point.enumeration]
    }:
        raise IllegalDataValue(f"{point.name}: {value:g} is not one of its states")
    if point.bits is not None and word & ~sum(1 << bit.number for bit in device_map.bit_tables[point.bits]):
        raise IllegalDataValue(f"{point.name}: 0x{word:04X} has bits without a name")
    if point.access is Access.SET and word != 1:
        raise IllegalDataValue(f"{point.name} can only be set")
    return value
