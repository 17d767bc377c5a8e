"""Which controllers hang on which line, and the controllers built from it.

The default is the demo's: two lines, with a factory address 1 on each, and a TriStar beside the ProStars.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from gateway.devices.model import DeviceMap
from gateway.devices.schema import load_map, models
from gateway.simulator.device import DEFAULT_TURNAROUND_S, SimulatedController
from gateway.simulator.line import SimulatedLine
from gateway.simulator.oracle import OracleController
from gateway.simulator.pty import PtyLine
from gateway.simulator.server import Controller

_WAKE_BYTES = 8
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")
_ADDRESSES = range(1, 248)


@dataclass(frozen=True, slots=True)
class LinePlan:
    """A line's name and the addresses of its controllers, with the models of those that are not the site's own."""

    name: str
    addresses: tuple[int, ...]
    models: Mapping[int, str] = field(default_factory=dict)  # address → model

    @classmethod
    def parse(cls, text: str) -> LinePlan:
        """Read NAME=ADDR,ADDR:MODEL; ValueError says what is wrong."""
        name, separator, listed = text.partition("=")
        if not separator or not _NAME.fullmatch(name):
            raise ValueError(f"{text!r} is not NAME=ADDRESS,ADDRESS… (a name has letters, digits and . _ -)")
        units = [unit.partition(":") for unit in listed.split(",")]
        try:
            addresses = tuple(int(address) for address, _, _ in units)
        except ValueError:
            raise ValueError(f"{text!r}: addresses are numbers separated by commas") from None
        if any(address not in _ADDRESSES for address in addresses):
            raise ValueError(f"{text!r}: an address is 1 to 247")
        named = {int(address): model for address, colon, model in units if colon}
        if unknown := set(named.values()) - set(models()):
            raise ValueError(f"{text!r}: no model is called {min(unknown)!r}; known: {', '.join(models())}")
        return cls(name, addresses, named)


DEMO_LAYOUT = (LinePlan("shelter-a", (1, 2)), LinePlan("shelter-b", (1, 2), {2: "tristar-mppt"}))


@dataclass(frozen=True, slots=True)
class Behaviour:
    """How all controllers of a site behave."""

    seed: int = 0
    speed: float = 1.0
    start_hour: float = 8.0
    turnaround_s: float = DEFAULT_TURNAROUND_S
    oracle: bool = False


@dataclass(frozen=True, slots=True)
class SimulatedSite:
    """The lines of a layout as ptys, in its order; the controllers hang on `line.line.stations`."""

    plans: tuple[LinePlan, ...]
    lines: tuple[PtyLine, ...]
    controllers: tuple[Controller, ...]

    @classmethod
    def build(
        cls,
        device_map: DeviceMap,
        plans: Sequence[LinePlan] = DEMO_LAYOUT,
        behaviour: Behaviour | None = None,
        link_dir: Path | None = None,
    ) -> SimulatedSite:
        """Make everything, of `device_map` where a plan names no model; nothing is opened yet.

        ValueError when names repeat or the oracle has no room.
        """
        how = behaviour or Behaviour()
        if len({plan.name for plan in plans}) != len(plans):
            raise ValueError("line names repeat")
        lines: list[PtyLine] = []
        controllers: list[Controller] = []
        for plan in plans:
            stations = [
                _controller(
                    load_map(plan.models[address]) if address in plan.models else device_map,
                    how,
                    len(controllers) + k,
                    address,
                )
                for k, address in enumerate(plan.addresses)
            ]
            controllers += stations
            link = None if link_dir is None else link_dir / plan.name
            lines.append(PtyLine(SimulatedLine(stations, wake_bytes=_WAKE_BYTES), link=link))
        return cls(tuple(plans), tuple(lines), tuple(controllers))

    def open(self) -> None:
        """Open all ptys, or none: OSError when the system refuses one."""
        try:
            for line in self.lines:
                line.open()
        except OSError:
            self.close()
            raise

    def close(self) -> None:
        """Close all ptys and remove their links."""
        for line in self.lines:
            line.close()


def _controller(device_map: DeviceMap, how: Behaviour, number: int, address: int) -> Controller:
    if how.oracle:
        return OracleController(device_map, device=number, address=address, turnaround_s=how.turnaround_s)
    return SimulatedController(
        device_map,
        address=address,
        seed=how.seed + number,
        speed=how.speed,
        start_hour=how.start_hour,
        turnaround_s=how.turnaround_s,
    )
