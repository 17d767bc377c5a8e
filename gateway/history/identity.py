"""Whose log is it? A history belongs to a controller, not to a name in the configuration.

A controller is one by its serial number, where it tells one (the register is undocumented). Else it is known by its
place (line and device name), and proved by its log: two controllers do not share blocks of sixteen words.

Rule 1: a controller whose hourmeter, product or serial number is not what the history knows is another one. The
        hourmeter goes back no further than a controller loses with its power (`LOST_HOURS`).
Rule 2: the same log is the same controller, wherever it is found: a renamed device or a controller that was moved
        to another line goes on with its history. A log is the same when `PROOF_DAYS` blocks are, or all that it has.
Rule 3: without a common block it is the controller last seen in its place if nothing speaks against it: the ring has
        no day that the history should have and has not (it was away for more than a ring, or its log was
        cleared), and the hourmeter grew no faster than time.
Rule 4: a controller that is claimed by another device of this gateway at the same time is not taken from it.
Rule 5: whoever is left is new, and starts a history of its own.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass

from gateway.devices.log import LOST_HOURS
from gateway.devices.model import WordOrder
from gateway.history.dates import CLOCK_S, DRIFT, HOUR_S, Look
from gateway.history.ring import Ring

PROOF_DAYS = 3


@dataclass(frozen=True, slots=True)
class Place:
    """Where a controller is: names of the configuration, and the unit id."""

    line: str
    device: str
    unit_id: int


@dataclass(frozen=True, slots=True)
class Seen:
    """What the controller at a place says of itself now; "" for what it does not tell."""

    place: Place
    model: str
    product: str
    revision: str
    serial: str
    look: Look


@dataclass(frozen=True, slots=True)
class Position:
    """The newest day that the history has of a controller: where the next harvest begins."""

    slot: int
    hourmeter: int
    words: bytes
    order: WordOrder


@dataclass(frozen=True, slots=True)
class Known:
    """A controller of the history."""

    key: int
    identity: str
    model: str
    product: str
    serial: str
    place: Place  # where it was last seen
    look: Look  # when it was last harvested
    position: Position | None  # None: its ring has to be read whole


def fits(known: Known, seen: Seen) -> bool:
    """Whether `seen` can be that controller at all (rule 1)."""
    return (
        known.model == seen.model
        and not (known.serial and seen.serial and known.serial != seen.serial)
        and not (known.product and seen.product and known.product != seen.product)
        and seen.look.hours >= known.look.hours - LOST_HOURS
    )


def expected(controllers: Iterable[Known], seen: Seen, taken: Collection[int] = ()) -> Known | None:
    """The controller that should be there: that of the serial number, else the last one of the place that fits."""
    able = [known for known in controllers if known.key not in taken and fits(known, seen)]
    for same in (
        [known for known in able if seen.serial and known.serial == seen.serial],
        [known for known in able if (known.place.line, known.place.device) == (seen.place.line, seen.place.device)],
    ):
        if same:
            return max(same, key=lambda known: (known.look.wall, known.key))
    return None


def owner(
    controllers: Iterable[Known], seen: Seen, ring: Ring, common: Mapping[int, int], taken: Collection[int] = ()
) -> Known | None:
    """The controller whose ring this is, or None for a new one (rules 2 to 5).

    `common` says by controller how many of its stored days are blocks of the ring.
    """
    able = {known.key: known for known in controllers if known.key not in taken and fits(known, seen)}
    needed = max(1, min(PROOF_DAYS, len(ring.days)))
    proved = {key: days for key, days in common.items() if key in able and days >= needed}
    if proved:
        return able[max(proved, key=lambda key: (proved[key], key))]
    last = expected(able.values(), seen)
    if last is None or (last.position is not None and _contradicts(ring, last.position, common.get(last.key, 0))):
        return None
    return last if last.serial and last.serial == seen.serial else _in_time(last, seen)


def _contradicts(ring: Ring, position: Position, common: int) -> bool:
    return not common and any(day.hourmeter <= position.hourmeter for day in ring.days)


def _in_time(known: Known, seen: Seen) -> Known | None:
    if not (known.look.clock_set and seen.look.clock_set):
        return known
    passed_s = seen.look.wall - known.look.wall
    if passed_s < 0:
        return known  # the clock was wrong at one of the looks: no evidence
    slack_s = 2 * HOUR_S + CLOCK_S + DRIFT * abs(passed_s)
    return known if (seen.look.hours - known.look.hours) * HOUR_S <= passed_s + slack_s else None
