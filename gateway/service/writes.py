"""Writing, from the configuration: which rules there are, what is wrong with them, what is worth a second look."""

from __future__ import annotations

import ipaddress
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path as FilePath
from typing import TYPE_CHECKING

from gateway.core.site import Device
from gateway.core.write_rules import Network, Range, WriteRule, WriteRules
from gateway.core.write_wear import WearLimits
from gateway.devices.agreement import all_maps
from gateway.devices.model import Access, DeviceMap, Point, Space
from gateway.devices.schema import load_map, models
from gateway.devices.unknown import AUTO
from gateway.faces.modbus.settings import WriteSettings
from gateway.service.parsing import parse_range
from gateway.service.problems import Path, Problem, show

if TYPE_CHECKING:  # what it is at run time, plain.py says
    from gateway.service.schema import Config, WriteTable

Raw = Mapping[str, object]

SHOWN = 3
"""So many settings are named in a piece of advice."""


def write_rules(config: Config) -> tuple[WriteRule, ...]:
    """The rules of the file; none where writes are off."""
    if not config.modbus.writes:
        return ()
    return tuple(_rule(table) for table in config.modbus.write)


def write_settings(config: Config) -> WriteSettings | None:
    """What the Modbus TCP face needs to let anybody write; None where every write is refused."""
    if not config.modbus.writes:
        return None
    limits = WearLimits(config.modbus.eeprom_writes_per_day, config.modbus.write_interval_s)
    return WriteSettings(write_rules(config), FilePath(config.state_dir), limits)


def line_writes(rules: Sequence[WriteRule], devices: Sequence[Device]) -> bool:
    """Whether a line with these devices ever has a write to send."""
    return any(
        WriteRules(rules, device) or (device.auto and any(rule.allowed(each) for rule in rules for each in all_maps()))
        for device in devices
    )


def rule_problems(tables: Sequence[tuple[Path, Raw]], devices: Sequence[Raw]) -> Iterator[Problem]:
    """What is wrong with `[[modbus.write]]` tables, beyond the form; `devices`: the raw `[[line.device]]` tables."""
    named = (*models(), AUTO)  # a tuple: what the file holds there may be no hashable thing
    known = [device for device in devices if device.get("model") in named and isinstance(device.get("unit_id"), int)]
    for path, table in tables:
        wanted = table.get("unit_id")
        chosen = [device for device in known if not isinstance(wanted, list) or device["unit_id"] in wanted]
        for index, unit in enumerate(wanted if isinstance(wanted, list) else ()):
            if isinstance(unit, int) and unit not in [device["unit_id"] for device in known]:
                units = ", ".join(str(device["unit_id"]) for device in known)
                yield Problem((*path, "unit_id", index), f"no device has unit id {unit}; allowed: {units or 'none'}")
        if chosen:
            maps = _maps(str(device["model"]) for device in chosen)
            yield from _named(path, table, maps)
            yield from _ranges(path, table, maps)
        if not any(table.get(key) for key in ("source", "role")):
            yield Problem(path, "holds for nobody; allowed: source or role, at least one of them")
        if not any(table.get(key) for key in ("point", "registers", "coils")):
            yield Problem(path, "allows nothing; allowed: point, registers or coils, at least one of them")


def write_advice(config: Config) -> Iterator[str]:
    """What an experienced colleague would say."""
    modbus = config.modbus
    if not modbus.writes:
        if modbus.write:
            yield "modbus.write: has no effect as long as modbus.writes is false"
        return
    if not modbus.write:
        yield "modbus.writes: there is no [[modbus.write]] rule, so nobody may write"
    maps = _maps(device.model for line in config.line for device in line.device)
    for index, table in enumerate(modbus.write):
        path = f"modbus.write[{index}]"
        for number, text in enumerate(table.source):
            network = ipaddress.ip_network(text)
            if not any(_overlap(network, ipaddress.ip_network(allowed)) for allowed in modbus.allow):
                yield f"{path}.source[{number}]: {network} may not connect at all (modbus.allow)"
            if network.prefixlen == 0:
                yield f"{path}.source[{number}]: {network} is everybody"
            elif not network.is_loopback and network.num_addresses > 1:
                yield f"{path}.source[{number}]: each of {network.num_addresses} addresses ({network}) may write"
        yield from _wear_advice(path, table, maps)
        left_out = dict.fromkeys(
            point.name
            for device_map in maps
            for point in device_map.points
            if point.named_only and point.name not in table.point and _covered(table, point)
        )
        if left_out:
            yield f"{path}: to be written, these must be named in point, whatever the ranges: {', '.join(left_out)}"


def _wear_advice(path: str, table: WriteTable, maps: Sequence[DeviceMap]) -> Iterator[str]:
    wearing = list(dict.fromkeys(point.name for each in maps for point in each.points if _wears(table, each, point)))
    if wearing:
        some = ", ".join(wearing[:SHOWN]) + (f" and {len(wearing) - SHOWN} more" if len(wearing) > SHOWN else "")
        yield (
            f"{path}: a write to {some} goes to the controller's EEPROM and can raise its setting-changed fault, "
            "which may keep charging and the load off until the controller is reset"
        )


def _wears(table: WriteTable, device_map: DeviceMap, point: Point) -> bool:
    """Whether the rule lets this setting, kept in EEPROM, be changed."""
    named = point.name in table.point or (not point.named_only and _covered(table, point))
    return named and point.access is Access.WRITE and device_map.wears(point)


def _maps(models_of: Iterable[str]) -> list[DeviceMap]:
    """The maps of these configured models, each once; of one that is to be found, all."""
    wanted = list(dict.fromkeys(models_of))
    return list(all_maps()) if AUTO in wanted else [load_map(model) for model in wanted]


def _rule(table: WriteTable) -> WriteRule:
    return WriteRule(
        sources=tuple(ipaddress.ip_network(source) for source in table.source) or None,
        roles=frozenset(table.role) or None,
        unit_ids=frozenset(table.unit_id) or None,
        points=frozenset(table.point),
        registers=tuple(Range(*parse_range(text)) for text in table.registers),
        coils=tuple(Range(*parse_range(text)) for text in table.coils),
    )


def _overlap(one: Network, other: Network) -> bool:
    return one.version == other.version and one.overlaps(other)


def _covered(table: WriteTable, point: Point) -> bool:
    ranges = table.coils if point.space is Space.COILS else table.registers
    return any(first <= point.address <= last for first, last in map(parse_range, ranges))


def _named(path: Path, table: Raw, maps: Sequence[DeviceMap]) -> Iterator[Problem]:
    points = {point.name: point for device_map in maps for point in device_map.points}
    writable = [name for name, point in points.items() if point.access is not Access.READ]
    names = table.get("point")
    for index, name in enumerate(names if isinstance(names, list) else ()):
        if isinstance(name, str) and name not in writable:
            what = "can only be read" if name in points else "is no point of these devices"
            yield Problem((*path, "point", index), f"{show(name)} {what}; allowed: {', '.join(writable)}")


def _ranges(path: Path, table: Raw, maps: Sequence[DeviceMap]) -> Iterator[Problem]:
    for key, space in (("registers", Space.REGISTERS), ("coils", Space.COILS)):
        texts = table.get(key)
        for index, text in enumerate(texts if isinstance(texts, list) else ()):
            try:
                first, last = parse_range(text)
            except (TypeError, ValueError):
                continue  # the schema says so
            rule = WriteRule(**{key: (Range(first, last),)})  # type: ignore[arg-type]  # one of its two range keys
            if not any(place[0] is space for device_map in maps for place in rule.allowed(device_map)):
                problem = f"{show(text)} has nothing that a range may allow; allowed: addresses of writable {key}"
                yield Problem((*path, key, index), problem)
