"""Log blocks made by hand, by the words of the document."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from itertools import pairwise

from gateway.devices.model import LogLayout, WordOrder
from gateway.devices.schema import load_map
from gateway.history.dates import Look
from gateway.history.identity import Place, Seen

HI_LO, LO_HI = WordOrder.HI_LO, WordOrder.LO_HI
MAP = load_map("prostar-mppt")
assert MAP.log is not None
LAYOUT: LogLayout = MAP.log
EMPTY = bytes(32)
ERASED = b"\xff" * 32
WALL = 1_795_000_000.0  # 2026-11-18
PLACE = Place("shelter-a", "array-1", 11)


def block(
    hourmeter: int, order: WordOrder = HI_LO, *, alarms: int = 0, low_v: float = 12.5, high_v: float = 14.25
) -> bytes:
    longs = (hourmeter, alarms, 0, 0)
    pairs = (((value >> 16, value & 0xFFFF) if order is HI_LO else (value & 0xFFFF, value >> 16)) for value in longs)
    return struct.pack(">8H5e3H", *(word for pair in pairs for word in pair), low_v, high_v, 60, 55, 70, 150, 0, 90)


def full_ring(hours: Sequence[int], order: WordOrder = HI_LO, first: int = 0, volts: float = 12.5) -> dict[int, bytes]:
    """A ring of 256 blocks in which the days begin at slot `first`, the others erased; each day a little different."""
    assert all(before != after for before, after in pairwise(hours)) or len(hours) < 2
    ring = dict.fromkeys(range(256), ERASED)
    for n, hour in enumerate(hours):
        ring[(first + n) % 256] = block(hour, order, low_v=volts - 0.0078125 * (n % 40))
    return ring


def seen(
    hours: int, *, wall: float = WALL, serial: str = "", product: str = "PS-MPPT-25M", place: Place = PLACE
) -> Seen:
    return Seen(place, "prostar-mppt", product, "v01.01.13", serial, Look(hours, wall))


def raw(blocks: Mapping[int, bytes]) -> dict[int, bytes]:
    """Only the blocks that were written."""
    return {slot: words for slot, words in blocks.items() if words not in {EMPTY, ERASED}}
