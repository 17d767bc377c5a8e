"""The words and coils a controller holds, addressed by number from the wire and by point name from within.

Every cell starts as 0, except those of the EEPROM, which start erased (0xFFFF) as a fresh part does: the
document names 0xFFFF as one of the two forms of "not set". So reserved words read as 0 in RAM and as 0xFFFF in EEPROM.

A point that the unit does not have, because its model or its product lacks it, is found by nobody and set in vain.
"""

from __future__ import annotations

import math
from array import array

from gateway.devices.codecs import read_words, write_words
from gateway.devices.model import DeviceMap, Extent, Kind, Point, Space, Value
from gateway.devices.texts import encode_text
from gateway.simulator.server import missing

ERASED = 0xFFFF


class Memory:
    """The cells of one unit, exactly the extents of its map that its product has."""

    def __init__(self, device_map: DeviceMap, extra: tuple[Extent, ...] = (), product: str = "") -> None:
        there = [extent for extent in device_map.extents if device_map.on_product(extent, product)]
        self._areas = [(extent, array("H", [0]) * extent.count) for extent in (*there, *extra)]
        for extent, cells in self._areas:
            if extent.wears:
                cells[:] = array("H", [ERASED]) * extent.count
        points = [
            point
            for point in device_map.points
            if any(e.space is point.space and e.first <= point.address <= e.last for e in there)
        ]
        self._points = {point.name: point for point in points}
        self._at = {(point.space, point.address + k): point for point in points for k in range(point.words)}

    def read(self, space: Space, first: int, count: int) -> list[int]:
        """The cells of a range; IllegalDataAddress unless all of them are there."""
        for extent, cells in self._areas:
            if extent.space is space and extent.first <= first <= extent.last:
                offset = first - extent.first
                found = cells[offset : offset + count].tolist()
                if len(found) == count:
                    return found
                return found + self.read(space, extent.last + 1, count - len(found))
        raise missing(space, first)

    def store(self, space: Space, first: int, *cells: int) -> None:
        """Put raw cells at consecutive addresses of one extent; IllegalDataAddress when they do not fit."""
        for extent, area in self._areas:
            if extent.space is space and extent.first <= first and first + len(cells) - 1 <= extent.last:
                area[first - extent.first : first - extent.first + len(cells)] = array("H", cells)
                return
        raise missing(space, first)

    def point(self, name: str) -> Point:
        """The point of that name; KeyError when the model has none."""
        return self._points[name]

    def point_at(self, space: Space, address: int) -> Point | None:
        """The point that has a cell at that address; None for a reserved one."""
        return self._at.get((space, address))

    def in_eeprom(self, space: Space, address: int) -> bool:
        """Whether the address lies in the EEPROM."""
        return any(
            extent.wears and extent.space is space and extent.first <= address <= extent.last
            for extent, _ in self._areas
        )

    def has(self, name: str) -> bool:
        """Whether the unit has a point of that name."""
        return name in self._points

    def get(self, name: str) -> Value | None:
        """The value of a point by the document's reading; None for "no value" and for a point that is not there."""
        point = self._points.get(name)
        if point is None:
            return None
        words = self.read(point.space, point.address, point.words)
        return read_words(point.reading(), words, self._scaling(point))

    def set(self, name: str, value: Value) -> None:
        """Store a value as the document says; NaN is the way to say "no value"."""
        point = self._points.get(name)
        if point is None:
            return
        if point.space is Space.COILS:
            self.store(point.space, point.address, int(value))
            return
        reading = point.reading()
        if reading.absent and math.isnan(value):
            self.store(point.space, point.address, min(reading.absent))
        else:
            self.store(point.space, point.address, *write_words(reading, value, point.words, self._scaling(point)))

    def set_text(self, name: str, text: str) -> None:
        """Store the text of a point that is one."""
        point = self._points.get(name)
        if point is not None and point.kind is Kind.TEXT:
            reading = point.reading()
            self.store(point.space, point.address, *encode_text(reading.codec, text, point.words, reading.order))

    def _scaling(self, point: Point) -> dict[str, Value]:
        found = ((name, self.get(name)) for name in point.reading().factors)
        return {name: value for name, value in found if value is not None}
