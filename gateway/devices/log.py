"""The daily log: a ring of equal blocks, one a day, put in order by their hourmeter.

Rule 1: a block whose hourmeter is zero or all ones (24 or 32 bits) was never written and is left out.
Rule 2: the document says high word first, units in the field were seen with the low word first. The right order
        is the one in which the hourmeters grow along the ring and none is ahead of the live hourmeter, but for what a
        unit loses that loses its power (`LOST_HOURS`); while both would do, the one whose days lie closer together, and
        then the document's. All 32-bit fields of a log share one order.
Rule 3: going once around the ring, the hourmeter steps back exactly once, from the newest day to the oldest.
Rule 4: values come in base units: minutes become seconds.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from struct import Struct
from types import MappingProxyType

from gateway.devices.codecs import combine, decode
from gateway.devices.model import LogLayout, Value, WordOrder

HOURMETER = "hourmeter"
"""Name of the field that every log layout must have."""

LOST_HOURS = 25
"""A unit that lost its power counts on from the hours that EEPROM has, which were written up to a day before."""

_NEVER_WRITTEN = frozenset({0, 0x00FF_FFFF, 0xFFFF_FFFF})


@dataclass(frozen=True, slots=True)
class LogDay:
    """One day of the log. `values` are in the units of the layout's fields; a field without value is absent."""

    slot: int  # position in the ring
    hourmeter: int  # hours, when the day was written
    values: Mapping[str, Value]


@dataclass(frozen=True, slots=True)
class DailyLog:
    """The days found, oldest first, with the word order they were read in."""

    days: tuple[LogDay, ...]
    order: WordOrder
    certain: bool  # False while the other order would fit as well, or neither does
    empty: int  # blocks that were never written


def split_blocks(layout: LogLayout, data: bytes, first_slot: int = 0) -> dict[int, bytes]:
    """Cut the bytes of a read that began at `first_slot` into blocks; ValueError when they are not whole blocks."""
    size = 2 * layout.block_words
    if len(data) % size:
        raise ValueError(f"{len(data)} bytes are not whole blocks of {size}")
    return {first_slot + n: data[n * size : (n + 1) * size] for n in range(len(data) // size)}


def hourmeter_of(layout: LogLayout, block: bytes, order: WordOrder) -> int | None:
    """The hours at which a block was written, or None when it never was; ValueError when it has another size."""
    if len(block) != 2 * layout.block_words:
        raise ValueError(f"a log block has {len(block)} bytes, not {2 * layout.block_words}")
    meter = next(field for field in layout.fields if field.name == HOURMETER)
    pair = Struct(f">{meter.words}H").unpack_from(block, 2 * meter.offset)
    return None if _never_written(pair) else combine(pair, order)


def decode_log(
    layout: LogLayout,
    blocks: Mapping[int, bytes],
    live_hourmeter: int | None = None,
    known_order: WordOrder | None = None,
) -> DailyLog:
    """Decode log blocks by slot (each `block_words` big-endian words), all or some of the ring.

    `live_hourmeter` in hours makes the word order more certain; `known_order` is taken as it is. ValueError when a
    block has another size.
    """
    words = Struct(f">{layout.block_words}H")
    raw: dict[int, tuple[int, ...]] = {}
    for slot in sorted(blocks):
        if len(blocks[slot]) != words.size:
            raise ValueError(f"log block {slot} has {len(blocks[slot])} bytes, not {words.size}")
        raw[slot] = words.unpack(blocks[slot])
    meter = next(field for field in layout.fields if field.name == HOURMETER)
    pairs = {slot: block[meter.offset : meter.offset + meter.words] for slot, block in raw.items()}
    written = {slot: pair for slot, pair in pairs.items() if not _never_written(pair)}
    order, certain = (
        detect_order(tuple(written.values()), live_hourmeter) if known_order is None else (known_order, True)
    )
    days = [
        LogDay(slot, combine(pair, order), MappingProxyType(_values(layout, raw[slot], order)))
        for slot, pair in written.items()
    ]
    days.sort(key=lambda day: (day.hourmeter, day.slot))
    return DailyLog(tuple(days), order, certain, len(raw) - len(written))


def detect_order(pairs: Sequence[Sequence[int]], live_hourmeter: int | None = None) -> tuple[WordOrder, bool]:
    """The word order of hourmeter words given in ring order, and whether it is the only one that fits."""
    hours = {order: [combine(pair, order) for pair in pairs] for order in WordOrder}
    misfits = {order: _misfits(hours[order], live_hourmeter) for order in WordOrder}
    spans = {order: max(hours[order], default=0) - min(hours[order], default=0) for order in WordOrder}
    order = min((WordOrder.HI_LO, WordOrder.LO_HI), key=lambda order: (misfits[order], spans[order]))
    return order, min(misfits.values()) == 0 < max(misfits.values())


def _misfits(hours: Sequence[int], live_hourmeter: int | None) -> int:
    ahead = 0 if live_hourmeter is None else sum(hour > live_hourmeter + LOST_HOURS for hour in hours)
    around = [*hours, *hours[:1]]
    steps_back = sum(later < earlier for earlier, later in pairwise(around))
    return ahead + max(0, steps_back - 1)


def _never_written(pair: Sequence[int]) -> bool:
    return any(combine(pair, order) in _NEVER_WRITTEN for order in WordOrder)


def _values(layout: LogLayout, block: Sequence[int], order: WordOrder) -> dict[str, Value]:
    values: dict[str, Value] = {}
    for field in layout.fields:
        value = decode(field.codec, block[field.offset : field.offset + field.words], order, field.scale)
        if value is not None:
            values[field.name] = value
    return values
