"""The poll plan: which blocks to read so that every shown point is read, in as few requests as possible.

Rule 1: whole blocks. Reserved words between points are read along: a second request costs more wire time
        than ten words, and the devices answer them.
Rule 2: a block begins and ends with a shown point, holds at most 125 registers or 2000 coils (application
        protocol V1.1b3, clauses 6.1 and 6.3) and never tears a point of several words.
Rule 3: where it can be had, no two register blocks of a device are equally long: a late reply to one can then
        never be taken for the reply to another.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from gateway.devices.model import DeviceMap, Extent, Point, PollClass, Space

MAX_REGISTERS = 125
MAX_COILS = 2000


@dataclass(frozen=True, slots=True)
class PlannedBlock:
    """One read of the poll plan."""

    space: Space
    first: int
    count: int
    poll: PollClass

    @property
    def last(self) -> int:
        """The last address in the block."""
        return self.first + self.count - 1


def limit(space: Space) -> int:
    """The most registers or coils one request may ask for."""
    return MAX_REGISTERS if space is Space.REGISTERS else MAX_COILS


def poll_plan(device_map: DeviceMap) -> tuple[PlannedBlock, ...]:
    """The blocks that are polled, in the order of the map's extents; the daily log is never among them."""
    blocks: list[PlannedBlock] = []
    for extent in device_map.extents:
        if extent.poll is PollClass.BACKGROUND:
            continue
        for block in _cover(extent, _points_in(device_map, extent)):
            blocks.append(_unequal(block, extent, blocks))
    return tuple(blocks)


def split(block: PlannedBlock, device_map: DeviceMap) -> tuple[PlannedBlock, PlannedBlock] | None:
    """Cut a block that the device refused in two, of unequal length where possible.

    A point stays whole. None when there is nothing to cut: one register or coil, or one point.
    """
    torn = {
        point.address + k for point in device_map.points if point.space is block.space for k in range(1, point.words)
    }
    middle = block.count // 2 + (block.count > 2 and block.count % 2 == 0)
    cuts = [cut for cut in range(1, block.count) if block.first + cut not in torn]
    if not cuts:
        return None
    cut = min(cuts, key=lambda cut: (abs(cut - middle), cut))
    return (
        replace(block, count=cut),
        replace(block, first=block.first + cut, count=block.count - cut),
    )


def _points_in(device_map: DeviceMap, extent: Extent) -> list[Point]:
    inside = [
        point
        for point in device_map.points
        if point.polled and point.space is extent.space and extent.first <= point.address <= extent.last
    ]
    return sorted(inside, key=lambda point: point.address)


def _cover(extent: Extent, points: Sequence[Point]) -> Iterator[PlannedBlock]:
    first = last = None
    for point in points:
        end = point.address + point.words - 1
        if first is not None and last is not None and end - first + 1 > limit(extent.space):
            yield PlannedBlock(extent.space, first, last - first + 1, extent.poll)
            first = None
        if first is None:
            first = point.address
        last = end
    if first is not None and last is not None:
        yield PlannedBlock(extent.space, first, last - first + 1, extent.poll)


def _unequal(block: PlannedBlock, extent: Extent, others: Sequence[PlannedBlock]) -> PlannedBlock:
    """The block, made longer inside its extent until no other register block has its length."""
    taken = {other.count for other in others if other.space is Space.REGISTERS}
    candidate = block
    while candidate.space is Space.REGISTERS and candidate.count in taken:
        if candidate.count == MAX_REGISTERS:
            return block
        if candidate.last < extent.last:
            candidate = replace(candidate, count=candidate.count + 1)
        elif candidate.first > extent.first:
            candidate = replace(candidate, first=candidate.first - 1, count=candidate.count + 1)
        else:
            return block
    return candidate
