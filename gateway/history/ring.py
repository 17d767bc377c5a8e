"""From the blocks of a ring to days that can be kept.

Rule 1: blocks that were never written are skipped; the word order is found by devices/log.py, unless it is known.
Rule 2: around the ring the hourmeter steps back once, from the newest day to the oldest. A block that does not fit
        is kept apart with a reason, so that one wrong hourmeter costs one block: of all ways to leave blocks out,
        the one that leaves out fewest.
Rule 3: a block ahead of the live hourmeter is kept apart. `LOST_HOURS` (devices/log.py) allow for a controller that
        lost its power, and for a day that ended in between.
Rule 4: of two written blocks with one hourmeter the first in ring order is the day, the other is kept apart.
Rule 5: two equal blocks are one.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from itertools import pairwise

from gateway.devices.log import LOST_HOURS, decode_log
from gateway.devices.model import LogLayout, Value, WordOrder


class Why(StrEnum):
    """Why a block is kept apart."""

    AHEAD = "ahead"  # of the live hourmeter
    ORDER = "order"  # between days that it cannot lie between
    TIE = "tie"  # another day has the same hourmeter


@dataclass(frozen=True, slots=True)
class Day:
    """A day of the log; `words` is its block as the controller holds it, `values` are in the units of the layout."""

    slot: int
    hourmeter: int
    words: bytes
    values: Mapping[str, Value]


@dataclass(frozen=True, slots=True)
class Apart:
    """A written block that is no day."""

    slot: int
    hourmeter: int
    words: bytes
    why: Why


@dataclass(frozen=True, slots=True)
class Ring:
    """What the blocks hold; days are oldest first."""

    days: tuple[Day, ...]
    apart: tuple[Apart, ...]
    order: WordOrder


def read_ring(
    layout: LogLayout, blocks: Mapping[int, bytes], live_hours: int, known_order: WordOrder | None = None
) -> Ring:
    """The days in these blocks by slot, all or some of a ring; ValueError when a block has another size."""
    log = decode_log(layout, blocks, live_hours, known_order)
    written = sorted((Day(d.slot, d.hourmeter, blocks[d.slot], d.values) for d in log.days), key=lambda day: day.slot)
    apart = [_apart(day, Why.AHEAD) for day in written if day.hourmeter > live_hours + LOST_HOURS]
    days = _rising([day for day in written if day.hourmeter <= live_hours + LOST_HOURS])
    kept = {day.slot for day in days}
    by_hour = {day.hourmeter: day for day in days}
    for day in written:
        if day.slot in kept or day.hourmeter > live_hours + LOST_HOURS:
            continue
        twin = by_hour.get(day.hourmeter)
        if twin is None:
            apart.append(_apart(day, Why.ORDER))
        elif twin.words != day.words:
            apart.append(_apart(day, Why.TIE))
    return Ring(tuple(days), tuple(sorted(apart, key=lambda block: block.slot)), log.order)


def _apart(day: Day, why: Why) -> Apart:
    return Apart(day.slot, day.hourmeter, day.words, why)


def _rising(days: Sequence[Day]) -> list[Day]:
    """The longest run of days around the ring whose hourmeters rise, oldest first (rules 2 and 4)."""
    starts = [0, *(n for n, (before, after) in enumerate(pairwise(days), 1) if after.hourmeter < before.hourmeter)]
    best: list[Day] = []
    for start in starts:
        run = _longest([*days[start:], *days[:start]])
        if len(run) > len(best):
            best = run
    return best


def _longest(days: Sequence[Day]) -> list[Day]:
    """The longest strictly rising subsequence; of equal hourmeters the first."""
    tops: list[int] = []  # the lowest hourmeter that ends a run of that length
    ends: list[int] = []  # index of the day that has it
    before: list[int] = []  # index of each day's predecessor in its run
    for n, day in enumerate(days):
        at = bisect_left(tops, day.hourmeter)
        before.append(ends[at - 1] if at else -1)
        if at == len(tops):
            tops.append(day.hourmeter)
            ends.append(n)
        elif day.hourmeter < tops[at]:
            tops[at], ends[at] = day.hourmeter, n
    run: list[Day] = []
    n = ends[-1] if ends else -1
    while n >= 0:
        run.append(days[n])
        n = before[n]
    return run[::-1]
