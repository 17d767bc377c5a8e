"""Is it still the same controller? Asked after every time the line was opened or a device came back.

Two adapters may swap their names, and every controller leaves the factory with address 1: the line answers as
before, with another controller's data. The model rarely tells two units apart and there is no serial number that
one can rely on, so counters are compared that only grow, and no faster than time and current allow.

Rule 1: what was configured, and else what was seen first, is expected; what a unit does not tell is not compared.
Rule 2: a counter is right between its last value and that plus what the time since can have added. A counter that
        a command clears is also right from zero up to that growth.
Rule 3: two units whose counters fit by chance are not told apart. Configure the serial number where there is one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from gateway.devices.model import Growing, Value

SLACK_UNITS = 1.0
"""Counters are read with a granularity of up to one unit (an hour)."""


@dataclass(frozen=True, slots=True)
class Identity:
    """What is known of a unit. None and missing counters are not compared; `at` is when the counters were read."""

    product: str | None = None
    revision: str | None = None
    serial_number: str | None = None
    counters: Mapping[str, Value] = field(default_factory=dict)
    at: float = 0.0

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
        hours = max(0.0, seen.at - self.at) / 3600
        for rule in growing:
            before, after = self.counters.get(rule.point), seen.counters.get(rule.point)
            if before is None or after is None:
                continue
            growth = rule.per_hour * hours + SLACK_UNITS
            cleared = rule.clearable and 0 <= after <= growth
            if not cleared and not before <= after <= before + growth:
                return f"{rule.point} is {after:g}, expected {before:g} to {before + growth:g}"
        return None

    def learned(self, seen: Identity) -> Identity:
        """This identity with what `seen` tells anew."""
        return replace(
            self,
            product=self.product or seen.product,
            revision=seen.revision or self.revision,
            serial_number=self.serial_number or seen.serial_number,
            counters=seen.counters or self.counters,
            at=seen.at if seen.counters else self.at,
        )
