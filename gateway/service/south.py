"""Everything south of the faces, of one configuration: its lines and devices.

Rule 1: a line whose port, wire and devices are those of before is the same object, with its connections, snapshots
        and counters; only what it can change at work is changed (`LineShell.adjust`).
Rule 2: any other line is a new one. The old one has to stop before it can have the port.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from gateway.clock import Clock
from gateway.core.settings import LineSettings
from gateway.core.site import Device, Site
from gateway.lines.factory import Line, make_line
from gateway.service.settings import line_devices, line_settings, line_sites

if TYPE_CHECKING:  # what it is at run time, plain.py says
    from gateway.service.schema import Config, DeviceTable


@dataclass(frozen=True, slots=True)
class Built:
    """A line and what it was made of."""

    line: Line
    settings: LineSettings
    tables: tuple[DeviceTable, ...]
    devices: tuple[Device, ...]


@dataclass(frozen=True, slots=True)
class South:
    """The lines in the order of the file, and the site that they are."""

    built: tuple[Built, ...]
    site: Site

    @classmethod
    def of(cls, config: Config, clock: Clock, before: South | None = None) -> South:
        """What the configuration wants, with those lines of `before` that it wants unchanged; nothing is opened."""
        known = {} if before is None else {built.settings.name: built for built in before.built}
        built: list[Built] = []
        for settings, table in zip(line_settings(config), config.line, strict=True):
            old = known.get(settings.name)
            if old is not None and old.settings.same_wire(settings) and old.tables == table.device:
                built.append(Built(old.line, settings, old.tables, old.devices))
                continue
            devices = line_devices(table)
            built.append(Built(make_line(settings, devices, clock), settings, table.device, devices))
        behind = line_sites(config)
        if before is not None and _alike(config.site, behind, built, before):
            return cls(tuple(built), before.site)
        found = [device for each in built for device in each.devices]
        return cls(tuple(built), Site.of(config.site, [each.line for each in built], found, behind))

    @property
    def lines(self) -> tuple[Line, ...]:
        """The lines alone."""
        return tuple(built.line for built in self.built)

    def unchanged(self, before: South) -> frozenset[int]:
        """The unit ids that stand for the same names of line and device as before."""
        places = {(device.unit_id, device.line.name, device.name) for device in before.site.devices}
        here = self.site.devices
        return frozenset(each.unit_id for each in here if (each.unit_id, each.line.name, each.name) in places)

    def adjust_lines(self, before: South) -> None:
        """Have the lines that stayed work by their new settings."""
        old = {built.line: built.settings for built in before.built}
        for built in self.built:
            if built.line in old and old[built.line] != built.settings:
                built.line.adjust(built.settings)


def _alike(name: str, behind: dict[str, str], built: list[Built], before: South) -> bool:
    """Whether it is the same site: the same lines in the same places, under the same name, no model found meanwhile."""
    places = [(each.line, each.settings.index) for each in built]
    same = not before.site.outdated and name == before.site.name and behind == before.site.behind
    return same and places == [(each.line, each.settings.index) for each in before.built]
