"""Is it still the same controller? Asked after every time the line was opened or a device came back.

Two adapters may swap their names, and every controller leaves the factory with address 1: the line answers as
before, with another controller's data. The model rarely tells two units apart and there is no serial number that
one can rely on, so counters are compared that only grow, and no faster than time and current allow.

Rule 1: what was configured, and else what was seen first, is expected; what a unit does not tell is not compared.
Rule 2: a counter is right between its last value and that plus what the time since can have added. A counter that
        a command clears is also right from zero up to that growth.
Rule 3: a unit that was without power goes on from what its memory kept, once a day. So its counters are right, too, if
        all of them go on from what was last seen there, or from what can have been stored since.
Rule 4: two units whose counters fit by chance are not told apart. Configure the serial number where there is one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple

from gateway.devices.model import Growing, Value

SLACK_UNITS = 1.0
"""Counters are read with a granularity of up to one unit (an hour)."""


class Kept(NamedTuple):
    """A counter in a unit's memory, by several readings, one of which is right, and when it was read."""

    readings: tuple[Value, ...]
    at: float


@dataclass(frozen=True, slots=True)
class Identity:
    """What is known of a unit. None and missing counters are not compared. `at` is when the counters were read."""

    product: str | None = None
    revision: str | None = None
    serial_number: str | None = None
    counters: Mapping[str, Value] = field(default_factory=dict)
    at: float = 0.0
    stored: Mapping[str, Kept] = field(default_factory=dict)

    @property
    def expects(self) -> bool:
        """Whether another unit could be told by this at all."""
        return bool(self.product or self.revision or self.serial_number or self.counters)

    def complaint(self, seen: Identity, growing: tuple[Growing, ...]) -> str | None:
        """Why `seen` is another unit than this one, in words, or None."""
        for what, expected, found in (
            ("product", self.product, seen.product),
            ("revision", self.revision, seen.revision),
            ("serial number", self.serial_number, seen.serial_number),
        ):
            if expected and found and expected != found:
                return f"{what} is {found}, expected {expected}"
        complaints = [self._misfit(rule, seen) for rule in growing]
        if any(complaints) and not all(self._goes_on(rule, seen) for rule in growing):
            return next(filter(None, complaints))
        return None

    def _misfit(self, rule: Growing, seen: Identity) -> str | None:
        """Rule 2."""
        before, after = self.counters.get(rule.point), seen.counters.get(rule.point)
        if before is None or after is None:
            return None
        growth = _growth(rule, self.at, seen.at)
        cleared = rule.clearable and 0 <= after <= growth
        if cleared or before <= after <= before + growth:
            return None
        return f"{rule.point} is {after:g}, expected {before:g} to {before + growth:g}"

    def _goes_on(self, rule: Growing, seen: Identity) -> bool:
        """Rule 3; what is not stored, or not known to be, has to fit by rule 2."""
        kept, after = self.stored.get(rule.point), seen.counters.get(rule.point)
        if kept is None or not kept.readings or after is None:
            return self._misfit(rule, seen) is None
        readings = (*kept.readings, 0) if rule.clearable else kept.readings
        growth = _growth(rule, kept.at, seen.at)
        return any(before <= after <= before + growth for before in readings)

    def learned(self, seen: Identity) -> Identity:
        """This identity with what `seen` tells anew."""
        return replace(
            self,
            product=self.product or seen.product,
            revision=seen.revision or self.revision,
            serial_number=self.serial_number or seen.serial_number,
            counters=seen.counters or self.counters,
            at=seen.at if seen.counters else self.at,
            stored={**self.stored, **seen.stored},  # the rest of them may have been refused
        )


def _growth(rule: Growing, before: float, after: float) -> float:
    """The most that a counter can have grown by between two moments."""
    return rule.per_hour * max(0.0, after - before) / 3600 + SLACK_UNITS
