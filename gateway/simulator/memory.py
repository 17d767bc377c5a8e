"""The words and coils a controller holds, addressed by number from the wire and by point name from within.

Every cell starts as 0, except those of the EEPROM, which start erased (0xFFFF) as a fresh part does: the
document names 0xFFFF as one of the two forms of "not set". So reserved words read as 0 in RAM and as 0xFFFF in EEPROM.
"""

from __future__ import annotations

from array import array

from gateway.devices.codecs import decode, encode
from gateway.devices.model import DeviceMap, Extent, Point, Space, Value
from gateway.simulator.server import missing

EEPROM = "eeprom"
"""Name of the extent that keeps settings without power."""

ERASED = 0xFFFF


class Memory:
    """The cells of one unit, exactly the extents of its map."""

    def __init__(self, device_map: DeviceMap, extra: tuple[Extent, ...] = ()) -> None:
        self._areas = [(extent, array("H", [0]) * extent.count) for extent in (*device_map.extents, *extra)]
        for extent, cells in self._areas:
            if extent.name == EEPROM:
                cells[:] = array("H", [ERASED]) * extent.count
        self._points = {point.name: point for point in device_map.points}
        self._at = {(point.space, point.address + k): point for point in device_map.points for k in range(point.words)}

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
            extent.name == EEPROM and extent.space is space and extent.first <= address <= extent.last
            for extent, _ in self._areas
        )

    def get(self, name: str) -> Value | None:
        """The value of a point by the document's reading; None for "no value" (NaN)."""
        point = self._points[name]
        reading = point.reading()
        words = self.read(point.space, point.address, point.words)
        if point.space is Space.COILS:
            return words[0]
        return decode(reading.codec, words, reading.order, reading.scale)

    def set(self, name: str, value: Value) -> None:
        """Store a value as the document says; NaN is the way to say "no value"."""
        point = self._points[name]
        if point.space is Space.COILS:
            self.store(point.space, point.address, int(value))
            return
        reading = point.reading()
        self.store(point.space, point.address, *encode(reading.codec, value, point.words, reading.order, reading.scale))
