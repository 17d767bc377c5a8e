"""Do the maps agree? A point of one name is one thing on every model, and a unit belongs to one of them.

MIB, metrics, dashboards and alerts serve all models by the names of the points. So points of one name have one
kind, unit, group, metric and MIB scale, and one MIB column where they do not say that theirs is another's; tables
of one name have one label a number; and no product code is claimed twice.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cache

from gateway.devices.model import DeviceMap, Point
from gateway.devices.schema import load_map, models
from gateway.errors import MapError


@cache
def all_maps() -> tuple[DeviceMap, ...]:
    """Every map that there is, by model; MapError when two of them disagree."""
    maps = tuple(load_map(model) for model in models())
    found = disagreements(maps)
    if found:
        raise MapError("\n".join(found))
    return maps


def map_of_product(product: str) -> DeviceMap | None:
    """The map of a unit that calls itself `product` by Read Device Identification, or None."""
    return next((device_map for device_map in all_maps() if device_map.identity.names(product)), None)


def disagreements(maps: Sequence[DeviceMap]) -> list[str]:
    """All that two maps do not say alike, one sentence each; empty when they agree."""
    return [problem for check in (_points, _tables, _severities, _conditions, _products) for problem in check(maps)]


def _points(maps: Sequence[DeviceMap]) -> Iterator[str]:
    known: dict[str, tuple[str, Point]] = {}
    for device_map in maps:
        for point in device_map.points:
            model, first = known.setdefault(point.name, (device_map.model, point))
            for what, mine, other in _aspects(point, first):
                if mine != other:
                    yield f"{device_map.model}: point {point.name}: {what} is {mine}, on {model} it is {other}"


def _aspects(one: Point, two: Point) -> Iterator[tuple[str, object, object]]:
    yield "kind", one.kind.value, two.kind.value
    yield "unit", one.unit, two.unit
    yield "group", one.group.value, two.group.value
    yield "space", one.space.value, two.space.value
    yield "metric", one.metric, two.metric
    yield "metric_scale", one.metric_scale, two.metric_scale
    if one.mib is not None and two.mib is not None:
        yield "MIB scale", one.mib.scale, two.mib.scale
        yield "MIB syntax", one.mib.syntax, two.mib.syntax
        if one.mib.named == two.mib.named:
            yield "MIB column", one.mib.column, two.mib.column
    else:
        yield "MIB column", one.mib, two.mib


def _tables(maps: Sequence[DeviceMap]) -> Iterator[str]:
    known: dict[tuple[str, int], tuple[str, str]] = {}
    for device_map in maps:
        entries = [
            (name, entry.number, entry.name)
            for tables in (device_map.enumerations, device_map.bit_tables)
            for name, table in tables.items()
            for entry in table
        ]
        for name, number, label in entries:
            model, other = known.setdefault((name, number), (device_map.model, label))
            if label != other:
                yield f"{device_map.model}: {name} {number} is {label}, on {model} it is {other}"


def _severities(maps: Sequence[DeviceMap]) -> Iterator[str]:
    """What one alert serves must be equally bad."""
    known: dict[tuple[str, str], tuple[str, str]] = {}
    for device_map in maps:
        for point in device_map.points:
            for bit in device_map.bit_tables.get(point.bits or "", ()):
                model, other = known.setdefault((point.name, bit.name), (device_map.model, bit.severity))
                if bit.severity != other:
                    yield f"{device_map.model}: {bit.name} of {point.name} is {bit.severity}, on {model} it is {other}"


def _conditions(maps: Sequence[DeviceMap]) -> Iterator[str]:
    """A condition's code means one thing."""
    known: dict[int, tuple[str, str]] = {}
    for device_map in maps:
        for point in device_map.points:
            if point.conditions is None:
                continue
            for bit in device_map.bit_tables[point.bits or ""]:
                code, name = point.conditions.first + bit.number, f"{point.conditions.name}_{bit.name}"
                model, other = known.setdefault(code, (device_map.model, name))
                if name != other:
                    yield f"{device_map.model}: condition {code} is {name}, on {model} it is {other}"


def _products(maps: Sequence[DeviceMap]) -> Iterator[str]:
    for device_map in maps:
        for other in maps:
            for product in device_map.identity.product_codes:
                if other is not device_map and other.identity.names(product):
                    yield f"{device_map.model}: product {product} is also claimed by {other.model}"
