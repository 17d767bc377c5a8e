"""What the fields of a stored day are called outside, by the map of its model.

A column is `<field>_<unit>` with the unit written out; hourmeters stay in hours here (OpenMetrics wants seconds).
A bit field is the names of the bits that are set; a bit without a name is `bit_<n>`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from gateway.devices.log import HOURMETER
from gateway.devices.model import DeviceMap, LogField, Value
from gateway.devices.schema import load_map, models
from gateway.devices.units import UNITS

_SUFFIXES = {"h": "hours"}


@dataclass(frozen=True, slots=True)
class Column:
    """A field of a model's log."""

    field: LogField
    name: str
    bits: Mapping[int, str] | None  # number → name; None: a number

    def show(self, values: Mapping[str, Value]) -> Value | list[str] | None:
        """The number, the names of the bits set, or None where the day has no value."""
        value = values.get(self.field.name)
        return value if value is None or self.bits is None else bit_names(int(value), self.bits)


def bit_names(value: int, names: Mapping[int, str]) -> list[str]:
    """Names of the bits that are set, the lowest first."""
    return [names.get(number, f"bit_{number}") for number in range(value.bit_length()) if value >> number & 1]


def columns(model: str) -> tuple[Column, ...]:
    """The fields of a model's log but for the hourmeter, in the order of the block; none of a model without a map."""
    if model not in models():
        return ()
    device_map = load_map(model)
    if device_map.log is None:
        return ()
    return tuple(_column(device_map, field) for field in device_map.log.fields if field.name != HOURMETER)


def _column(device_map: DeviceMap, field: LogField) -> Column:
    suffix = _SUFFIXES.get(field.unit, UNITS[field.unit].metric_suffix)
    name = f"{field.name}_{suffix}" if suffix else field.name
    bits = None if field.bits is None else {bit.number: bit.name for bit in device_map.bit_tables[field.bits]}
    return Column(field, name, bits)
