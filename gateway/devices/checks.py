"""Does a map make sense? Every rule that the form alone cannot express.

Each check takes the built map and yields problems, one sentence each, beginning with the entry it is about.
All run always, so that one look at the message is enough to repair a map.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from itertools import pairwise

from gateway.devices.codecs import CODECS
from gateway.devices.log import HOURMETER
from gateway.devices.model import (
    Access,
    DeviceMap,
    Emc1Form,
    Extent,
    Group,
    Kind,
    LogLayout,
    Point,
    PollClass,
    Reading,
    Released,
    Space,
)
from gateway.devices.texts import TEXT_CODECS
from gateway.devices.units import UNITS, info_name, metric_name

GATEWAYS_OWN = 400
"""Condition codes from here to 499 are what the gateway sees itself (core/conditions.py)."""

_STATE_CODECS = frozenset({"enum", "flag", "coil"})
_KNOWN_READ_FUNCTIONS = {1: Space.COILS, 2: Space.COILS, 3: Space.REGISTERS, 4: Space.REGISTERS}
_KNOWN_WRITE_FUNCTIONS = {5: Space.COILS, 6: Space.REGISTERS, 15: Space.COILS, 16: Space.REGISTERS}


def problems_of(device_map: DeviceMap) -> list[str]:
    """All that is wrong with a map, in the order of the file; empty when it is right."""
    return [problem for check in _CHECKS for problem in check(device_map)]


def _doubles(names: list[str], what: str) -> Iterator[str]:
    for name, count in Counter(names).items():
        if count > 1:
            yield f"{what} {name}: stands {count} times"


def _functions(device_map: DeviceMap) -> Iterator[str]:
    for key, known, given in (
        ("functions", _KNOWN_READ_FUNCTIONS, device_map.functions),
        ("write_functions", _KNOWN_WRITE_FUNCTIONS, device_map.write_functions),
    ):
        for code, space in given.items():
            if known.get(code) is not space:
                yield f"{key}: {code}: is no such function for {space.value}"
    for space in {extent.space for extent in device_map.extents} - set(device_map.functions.values()):
        yield f"functions: none reads {space.value}"


def _extents(device_map: DeviceMap) -> Iterator[str]:
    yield from _doubles([extent.name for extent in device_map.extents], "extent")
    for what, runs in (("extent", device_map.extents), ("reserved", device_map.reserved)):
        for run in runs:
            if run.last < run.first:
                yield f"{what} {run.name}: last 0x{run.last:04X} is before first 0x{run.first:04X}"
        ordered = sorted(runs, key=lambda run: (run.space, run.first))
        for one, two in pairwise(ordered):
            if one.space is two.space and two.first <= one.last:
                yield f"{what} {two.name}: overlaps {one.name} at 0x{two.first:04X}"
    for extent in device_map.extents:
        for product in set(extent.products) - set(device_map.identity.product_codes):
            yield f"extent {extent.name}: products: {product} is none of the product codes"
    for run in device_map.reserved:
        if _extent_of(device_map, run.space, run.first, run.last) is None:
            yield f"reserved {run.name}: 0x{run.first:04X}..0x{run.last:04X} is outside all extents"


def _extent_of(device_map: DeviceMap, space: Space, first: int, last: int) -> Extent | None:
    for extent in device_map.extents:
        if extent.space is space and extent.first <= first and last <= extent.last:
            return extent
    return None


def _places(device_map: DeviceMap) -> Iterator[str]:
    owner: dict[tuple[Space, int], str] = {}
    for point in device_map.points:
        last = point.address + point.words - 1
        extent = _extent_of(device_map, point.space, point.address, last)
        if extent is None:
            yield f"point {point.name}: 0x{point.address:04X} is outside all extents"
        elif extent.poll is PollClass.BACKGROUND and point.polled:
            yield f"point {point.name}: lies in extent {extent.name}, which is never polled"
        elif point.access is not Access.READ and not extent.writable:
            yield f"point {point.name}: access {point.access.value}, but extent {extent.name} is read only"
        for run in device_map.reserved:
            if run.space is point.space and point.address <= run.last and run.first <= last:
                yield f"point {point.name}: 0x{point.address:04X} lies in reserved {run.name}"
        for address in range(point.address, last + 1):
            other = owner.setdefault((point.space, address), point.name)
            if other != point.name:
                yield f"point {point.name}: overlaps point {other} at 0x{address:04X}"


def _points(device_map: DeviceMap) -> Iterator[str]:
    yield from _doubles([point.name for point in device_map.points], "point")
    names = {point.name for point in device_map.points}
    for point in device_map.points:
        prefix = f"point {point.name}: "
        yield from (prefix + problem for problem in _readings(point))
        yield from (prefix + problem for problem in _tables(point, device_map))
        yield from (prefix + problem for problem in _limits(point))
        if point.multiplied_by is not None and point.multiplied_by not in names:
            yield f"{prefix}multiplied_by: no point {point.multiplied_by}"


def _readings(point: Point) -> Iterator[str]:
    yield from _doubles([reading.name for reading in point.readings], "reading")
    for reading in point.readings:
        if reading.codec in TEXT_CODECS:
            yield from _text_reading(point, reading)
            continue
        codec = CODECS.get(reading.codec)
        if codec is None or point.kind is Kind.TEXT:
            known = TEXT_CODECS if point.kind is Kind.TEXT else (*CODECS, *TEXT_CODECS)
            yield f"reading {reading.name}: unknown codec {reading.codec!r}; known: {', '.join(known)}"
            continue
        if codec.space is not point.space:
            yield f"reading {reading.name}: codec {codec.name} is for {codec.space.value}"
        elif point.words not in codec.words:
            yield f"reading {reading.name}: codec {codec.name} does not fit {point.words} word(s)"
        if reading.scale <= 0:
            yield f"reading {reading.name}: scale must be above 0"


def _text_reading(point: Point, reading: Reading) -> Iterator[str]:
    codec = TEXT_CODECS[reading.codec]
    if point.kind is not Kind.TEXT:
        yield f"reading {reading.name}: codec {codec.name} gives text, the document's reading does not"
    if point.space is not Space.REGISTERS:
        yield f"reading {reading.name}: codec {codec.name} is for registers"
    elif point.words not in codec.words:
        yield f"reading {reading.name}: codec {codec.name} does not fit {point.words} word(s)"
    if reading.scale != 1 or reading.factors or reading.absent:
        yield f"reading {reading.name}: a text has no scale, nothing scales it and it has no absent numbers"


def _factors(device_map: DeviceMap) -> Iterator[str]:
    points = {point.name: point for point in device_map.points}
    for point in device_map.points:
        for reading in point.readings:
            for name in reading.factors:
                factor = points.get(name)
                prefix = f"point {point.name}: reading {reading.name}: scaled_by: "
                if factor is None:
                    yield f"{prefix}no point {name}"
                elif not factor.polled or factor.kind is not Kind.NUMBER or factor.space is not Space.REGISTERS:
                    yield f"{prefix}{name} is no polled number"
                elif any(each.factors for each in factor.readings):
                    yield f"{prefix}{name} is itself scaled by a point"


def _tables(point: Point, device_map: DeviceMap) -> Iterator[str]:
    codec = point.readings[0].codec
    if point.enumeration is not None and point.enumeration not in device_map.enumerations:
        yield f"unknown enumeration {point.enumeration!r}"
    if point.bits is not None and point.bits not in device_map.bit_tables:
        yield f"unknown bit table {point.bits!r}"
    if (codec == "enum") > (point.enumeration is not None) or (point.enumeration is not None) > (
        codec in _STATE_CODECS
    ):
        yield f"codec {codec} and enumeration {point.enumeration!r} do not belong together"
    if (codec == "bits") != (point.bits is not None):
        yield f"codec {codec} and bit table {point.bits!r} do not belong together"
    for bit in device_map.bit_tables.get(point.bits or "", ()):
        if bit.number >= 16 * point.words:
            yield f"bit {bit.number} of {point.bits} does not fit {point.words} word(s)"


def _limits(point: Point) -> Iterator[str]:
    if point.unit not in UNITS:
        yield f"unknown unit {point.unit!r}; known: {', '.join(filter(None, UNITS))}"
    if point.minimum is not None and point.maximum is not None and point.minimum > point.maximum:
        yield "minimum is above maximum"
    if point.kind is Kind.TEXT and (point.unit or point.plausible or point.access is not Access.READ):
        yield "a text has no unit and no plausible bounds, and cannot be written"
    if point.access is not Access.WRITE and (point.minimum, point.maximum) != (None, None):
        yield "minimum and maximum are for what can be written"
    if point.access is Access.SET and (point.space is not Space.COILS or point.group is not Group.COMMAND):
        yield "set only is for coils of group command"
    if point.plausible is not None and point.plausible[0] >= point.plausible[1]:
        yield "plausible: the first number must be below the second"


def _rules(device_map: DeviceMap) -> Iterator[str]:
    polled = {point.name for point in device_map.points if point.polled}
    for growing in device_map.identity.growing:
        if growing.point not in polled:
            yield f"identity: growing: no polled point {growing.point}"
        if growing.stored is not None and growing.stored not in polled:
            yield f"identity: growing: stored: no polled point {growing.stored}"
    if device_map.night is not None and device_map.night.point not in polled:
        yield f"night: no polled point {device_map.night.point}"
    for point in device_map.points:
        if point.access is Access.READ and (point.rewrite_s, point.restarts, point.named_only, point.wears) != (
            None,
            False,
            False,
            False,
        ):
            yield f"point {point.name}: rewrite_s, restarts, named_only and wears are for what can be written"
        if point.rewrite_s is None and point.released is not Released.BY_ZERO:
            yield f"point {point.name}: released is for what must be rewritten"
        if point.restarts and not point.named_only:
            yield f"point {point.name}: what restarts the device is named_only"


def _conditions(device_map: DeviceMap) -> Iterator[str]:
    firsts: dict[int, str] = {}
    names: dict[str, str] = {}
    for point in device_map.points:
        rule = point.conditions
        if rule is None:
            if point.bits is not None and point.group is Group.LIVE:
                yield f"point {point.name}: conditions: live bits need them, such as {{ first = 100, name = … }}"
            continue
        if point.bits is None or point.group is not Group.LIVE:
            yield f"point {point.name}: conditions: are for live bits"
        if rule.first % 100 or rule.first == GATEWAYS_OWN:
            yield f"point {point.name}: conditions: first {rule.first}; allowed: 100, 200, 300, 500 to 900"
        if firsts.setdefault(rule.first, point.name) != point.name:
            yield f"point {point.name}: conditions: first {rule.first} belongs to {firsts[rule.first]}"
        if names.setdefault(rule.name, point.name) != point.name:
            yield f"point {point.name}: conditions: name {rule.name} belongs to {names[rule.name]}"


def _load(device_map: DeviceMap) -> Iterator[str]:
    load = device_map.load
    if load is None:
        return
    point = next((point for point in device_map.points if point.polled and point.name == load.point), None)
    if point is None or point.enumeration is None:
        yield f"load: no polled enumeration {load.point}"
        return
    known = {value.number for value in device_map.enumerations.get(point.enumeration, ())}
    for number in sorted((load.disconnected | load.connected) - known):
        yield f"load: {number} is no value of {load.point}"
    for number in sorted(load.disconnected & load.connected):
        yield f"load: {number} is both connected and disconnected"


def _number_tables(device_map: DeviceMap) -> Iterator[str]:
    for kind, tables in (("enumeration", device_map.enumerations), ("bits", device_map.bit_tables)):
        for name, entries in tables.items():
            yield from _doubles([str(entry.number) for entry in entries], f"{kind} {name}: number")
            yield from _doubles([entry.name for entry in entries], f"{kind} {name}: name")


def _mib(device_map: DeviceMap) -> Iterator[str]:
    taken: dict[tuple[Group, int], str] = {}
    for point in device_map.points:
        prefix = f"point {point.name}: mib: "
        if point.mib is None:
            continue
        if point.group is Group.COMMAND:
            yield prefix + "group command has no table"
        other = taken.setdefault((point.group, point.mib.column), point.name)
        if other != point.name:
            yield f"{prefix}column {point.mib.column} of table {point.group.value} belongs to {other}"
        for syntax, kind in (("Enumeration", Kind.ENUMERATION), ("Bits", Kind.BITS), ("Text", Kind.TEXT)):
            if (point.mib.syntax == syntax) != (point.kind is kind):
                yield f"{prefix}syntax {point.mib.syntax} does not fit the point"
        unit = UNITS.get(point.unit)
        if unit is not None and unit.mib_units.get(point.mib.scale) != point.mib.units:
            allowed = ", ".join(f"scale {scale} {units!r}" for scale, units in unit.mib_units.items())
            yield f"{prefix}scale {point.mib.scale} {point.mib.units!r} for unit {point.unit!r}; allowed: {allowed}"


def _emc1(device_map: DeviceMap) -> Iterator[str]:
    known = [(point, point.emc1) for point in device_map.points if point.emc1 is not None]
    if known and device_map.emc1_root is None:
        yield "emc1: points have a number and the table has no root"
    yield from _doubles([str(found.number) for _, found in known], "emc1: number")
    for point, found in known:
        fits = {
            Emc1Form.FLOAT: point.enumeration is None and point.bits is None,
            Emc1Form.INTEGER: point.enumeration is not None or point.bits is not None,
            Emc1Form.UNSIGNED: point.mib is not None and point.mib.syntax == "Unsigned32",
            Emc1Form.COUNTS: point.kind is Kind.NUMBER and found.step is not None,
            Emc1Form.WORD: point.kind is Kind.NUMBER and point.words == 1 and point.space is Space.REGISTERS,
            Emc1Form.BITS: point.bits is not None,
        }
        if not fits[found.form]:
            yield f"point {point.name}: emc1: form {found.form} does not fit the point"
        if found.step is not None and found.form not in {Emc1Form.COUNTS, Emc1Form.UNSIGNED}:
            yield f"point {point.name}: emc1: form {found.form} has no step"


def _metrics(device_map: DeviceMap) -> Iterator[str]:
    yield from _doubles([point.metric for point in device_map.points if point.metric is not None], "metric")
    for point in device_map.points:
        unit = UNITS.get(point.unit)
        if point.metric is None or unit is None:
            continue
        if point.group is Group.COMMAND:
            yield f"point {point.name}: metric: group command has none"
        allowed = [metric_name(point.name, unit, counter=True)]
        if point.kind is Kind.TEXT:
            allowed = [info_name(point.name)]
        elif not point.name.endswith("_total"):
            allowed.append(metric_name(point.name, unit, counter=False))
        if point.metric not in allowed:
            yield f"point {point.name}: metric {point.metric}: must be {' or '.join(reversed(allowed))}"
        if point.metric_scale != unit.metric_scale:
            yield f"point {point.name}: metric_scale: must be {unit.metric_scale:g} for unit {point.unit!r}"
        if unit.metric_suffix and unit.metric_suffix in point.name.split("_"):
            yield f"point {point.name}: the name repeats the unit"


def _log(device_map: DeviceMap) -> Iterator[str]:
    layout = device_map.log
    if layout is None:
        return
    last = layout.first + layout.blocks * layout.block_words - 1
    extent = _extent_of(device_map, Space.REGISTERS, layout.first, last)
    if extent is None or extent.poll is not PollClass.BACKGROUND:
        yield f"log: 0x{layout.first:04X}..0x{last:04X} needs an extent of poll class background"
    yield from _doubles([field.name for field in layout.fields], "log: field")
    yield from _doubles([str(field.column) for field in layout.fields if field.column is not None], "log: column")
    if not any(field.name == HOURMETER and field.words == 2 for field in layout.fields):
        yield f"log: needs a field {HOURMETER} of 2 words to be put in order by"
    yield from (f"log: {problem}" for problem in _log_fields(device_map, layout))


def _log_fields(device_map: DeviceMap, layout: LogLayout) -> Iterator[str]:
    owner: dict[int, str] = {}
    for field in layout.fields:
        prefix = f"field {field.name}: "
        codec = CODECS.get(field.codec)
        if codec is None:
            yield f"{prefix}unknown codec {field.codec!r}; known: {', '.join(CODECS)}"
        elif field.words not in codec.words or codec.space is not Space.REGISTERS:
            yield f"{prefix}codec {codec.name} does not fit {field.words} word(s)"
        if field.unit not in UNITS:
            yield f"{prefix}unknown unit {field.unit!r}"
        if field.bits is not None and field.bits not in device_map.bit_tables:
            yield f"{prefix}unknown bit table {field.bits!r}"
        if field.name == HOURMETER and field.column is not None:
            yield f"{prefix}column: it is the index"
        if field.offset + field.words > layout.block_words:
            yield f"{prefix}ends after the block"
        for offset in range(field.offset, field.offset + field.words):
            other = owner.setdefault(offset, field.name)
            if other != field.name:
                yield f"{prefix}overlaps field {other} at offset {offset}"


_CHECKS: tuple[Callable[[DeviceMap], Iterator[str]], ...] = (
    _functions,
    _extents,
    _places,
    _points,
    _factors,
    _rules,
    _conditions,
    _load,
    _number_tables,
    _mib,
    _emc1,
    _metrics,
    _log,
)
