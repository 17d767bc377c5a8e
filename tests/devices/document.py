"""What the tests that hold a map against its document share; how a register is read, each says by itself."""

from __future__ import annotations

import math
from collections.abc import Mapping

from gateway.devices.model import DeviceMap, Point, Space, Value


def points_at(device_map: DeviceMap, space: Space, address: int) -> list[Point]:
    """The points that an address belongs to."""
    return [
        point
        for point in device_map.points
        if point.space is space and point.address <= address < point.address + point.words
    ]


def reserved_at(device_map: DeviceMap, space: Space, address: int) -> int:
    """How many reserved runs an address belongs to."""
    return sum(run.space is space and run.first <= address <= run.last for run in device_map.reserved)


def check_values(
    device_map: DeviceMap, first: int, count: int, values: Mapping[str, Value], expected_of: Mapping[str, float]
) -> None:
    """The registers of a block have these values, by symbol without blanks, as far as they are plausible."""
    for point in device_map.points:
        if point.space is not Space.REGISTERS or not first <= point.address < first + count:
            continue
        expected = expected_of.get(point.symbol.replace(" ", "_"))
        if expected is not None and point.plausible is not None:
            low, high = point.plausible
            expected = expected if low <= expected <= high else None
        if expected is None:
            assert point.name not in values
        else:
            assert math.isclose(values[point.name], expected, rel_tol=1e-12), point.name
