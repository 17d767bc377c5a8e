"""The EMC-1 view, from the configuration: which devices, where, and what is wrong with that."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

from gateway.devices.schema import load_map, models
from gateway.devices.unknown import AUTO
from gateway.faces.snmp.settings import Emc1Device
from gateway.service.parsing import parse_listen
from gateway.service.problems import Path, Problem, show

if TYPE_CHECKING:  # what it is at run time, plain.py says
    from gateway.service.schema import Config

Raw = Mapping[str, object]


def emc1_devices(config: Config, *, listen: bool) -> tuple[Emc1Device, ...]:
    """The devices that are shown so; without `listen` none has a port of its own."""
    return tuple(
        Emc1Device(each.unit_id, tuple((at.host, at.port) for at in map(parse_listen, each.listen)) if listen else ())
        for each in config.snmp.emc1
    )


def emc1_problems(tables: Sequence[tuple[Path, Raw]], devices: Sequence[tuple[Path, Raw]]) -> Iterator[Problem]:
    """Unit ids of no device, or of one whose model the converter does not know; `devices` are the raw tables."""
    known = {unit: device.get("model") for _, device in devices if isinstance(unit := device.get("unit_id"), int)}
    fitting = ", ".join(str(unit) for unit, model in known.items() if _knows(model))
    for path, table in tables:
        unit = table.get("unit_id")
        if not isinstance(unit, int) or isinstance(unit, bool) or not 1 <= unit <= 247:  # the schema says so
            continue
        if unit not in known:
            yield Problem((*path, "unit_id"), f"no device has unit_id {unit}; allowed: {fitting or 'none'}")
        elif known[unit] == AUTO:
            text = f'the model must be named, not "{AUTO}"; allowed: {fitting or "none"}'
            yield Problem((*path, "unit_id"), text)
        elif isinstance(known[unit], str) and known[unit] in models() and not _knows(known[unit]):
            text = f"the EMC-1 knows no {show(known[unit])}; allowed: {fitting or 'none'}"
            yield Problem((*path, "unit_id"), text)


def _knows(model: object) -> bool:
    return isinstance(model, str) and model in models() and load_map(model).emc1_root is not None
