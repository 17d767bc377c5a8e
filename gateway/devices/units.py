"""The units of the house, and what becomes of them in a metric and in the MIB.

Rule 1: a point's value is in its unit; nobody downstream converts but by the two tables here.
Rule 2: Prometheus gets base units (volts, seconds, watthours …); `metric_scale` = metric sample ÷ value.
Rule 3: SNMP gets integers in named sub-units; the UNITS clause follows from unit and scale alone.

Watt-hours and ampere-hours are kept instead of joules and coulombs: every meter, invoice and data
sheet of this trade uses them. Both are one word, because `_hours` alone would claim to be a time.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

METRIC_PREFIX = "morningstar_"


@dataclass(frozen=True, slots=True)
class Unit:
    """One unit: its symbol, its metric suffix and scale, and the UNITS clause for each MIB scale allowed."""

    symbol: str
    metric_suffix: str  # "" for a number without unit
    metric_scale: float
    mib_units: Mapping[int, str]


def _unit(symbol: str, suffix: str, metric_scale: float, mib_units: Mapping[int, str]) -> Unit:
    return Unit(symbol, suffix, metric_scale, MappingProxyType(dict(mib_units)))


UNITS: Mapping[str, Unit] = MappingProxyType(
    {
        unit.symbol: unit
        for unit in (
            _unit("", "", 1, {1: ""}),
            _unit("V", "volts", 1, {1000: "millivolts"}),
            _unit("A", "amperes", 1, {1000: "milliamperes"}),
            _unit("W", "watts", 1, {1000: "milliwatts"}),
            _unit("°C", "celsius", 1, {1000: "0.001 degrees Celsius"}),
            _unit("Ah", "amperehours", 1, {10: "0.1 ampere-hours", 1000: "milliampere-hours"}),
            _unit("kWh", "watthours", 1000, {10: "0.1 kilowatt-hours", 1000: "watt-hours"}),
            _unit("h", "seconds", 3600, {1: "hours"}),
            _unit("s", "seconds", 1, {1: "seconds"}),
            _unit("d", "seconds", 86400, {1: "days"}),
            _unit("Ω", "ohms", 1, {1000: "milliohms"}),
            _unit("V/°C", "volts_per_celsius", 1, {1_000_000: "microvolts per degree Celsius"}),
            _unit("ratio", "ratio", 1, {1000: "0.001"}),
        )
    }
)


def metric_name(point: str, unit: Unit, *, counter: bool) -> str:
    """The one metric name of a point; a counter ends in `_total`, and the point's own `_total` moves there."""
    base = point.removesuffix("_total") if counter else point
    name = METRIC_PREFIX + base
    if unit.metric_suffix:
        name += "_" + unit.metric_suffix
    return name + "_total" if counter else name


def info_name(point: str) -> str:
    """The metric name of a point that is a text: a series of 1 whose label holds it."""
    return f"{METRIC_PREFIX}{point}_info"
