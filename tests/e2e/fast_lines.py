"""The demo's four controllers on two ptys at 115200 8N2: `simulate --oracle`, twelve times as fast.

Reading all registers of the controllers twice takes minutes at 9600 baud; what a register holds is the same.
With `plants` behind the folder they are `simulate` without `--oracle`: a solar day, and a daily log. With `stranger`
there is one more, at address 3 of shelter-b, that calls itself something that no map knows. With a number there is a
TriStar behind that TCP port, which closes each connection after its reply.
"""

from __future__ import annotations

import asyncio
import signal
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from gateway.devices.schema import load_map
from gateway.modbus.rtu import Timing
from gateway.simulator.device import SimulatedController
from gateway.simulator.layout import SimulatedSite
from gateway.simulator.line import SimulatedLine, Station
from gateway.simulator.oracle import OracleController
from gateway.simulator.pty import PtyLine
from gateway.simulator.tcp import TcpServer
from gateway.simulator.upstream import Habits, SimulatedServer

BAUDRATE = 115200
LAYOUT = {
    "shelter-a": ((1, "prostar-mppt"), (2, "prostar-mppt")),
    "shelter-b": ((1, "prostar-mppt"), (2, "tristar-mppt")),
}


def controllers() -> dict[str, list[OracleController]]:
    """The controllers by line; each has registers of its own, so that no word is like another's."""
    found: dict[str, list[OracleController]] = {}
    number = 0
    for line, units in LAYOUT.items():
        for address, model in units:
            found.setdefault(line, []).append(OracleController(load_map(model), device=number, address=address))
            number += 1
    return found


class Stranger(OracleController):
    """A controller of another maker's mind."""

    def identification(self) -> Mapping[int, bytes]:
        """What no map knows."""
        return {**super().identification(), 1: b"SS-MPPT-15L"}


def networked() -> OracleController:
    """The controller with a network of its own."""
    return OracleController(load_map("tristar-mppt"), device=4)


def plants() -> dict[str, list[SimulatedController]]:
    """The same with a plant each."""
    site = SimulatedSite.build(load_map("prostar-mppt"))
    found: dict[str, list[SimulatedController]] = {}
    names = [plan.name for plan in site.plans for _ in plan.addresses]
    for name, station in zip(names, site.controllers, strict=True):
        assert isinstance(station, SimulatedController)
        found.setdefault(name, []).append(station)
    return found


async def run(folder: Path, stations_of: Mapping[str, Sequence[Station]], port: int | None) -> None:
    """Serve until SIGTERM."""
    stop = asyncio.Event()
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, stop.set)
    timing = Timing.of(BAUDRATE, 8, "N", 2)
    lines = [
        PtyLine(SimulatedLine(stations, timing=timing), link=folder / name) for name, stations in stations_of.items()
    ]
    server = TcpServer(SimulatedServer([networked()], habits=Habits(closes=True)), port=port or 0)
    if port is not None:
        await server.open()
    for line in lines:
        line.open()
    await stop.wait()
    for line in lines:
        line.close()
    server.close()


if __name__ == "__main__":
    chosen: dict[str, list[Station]] = {
        name: [*stations] for name, stations in (plants() if "plants" in sys.argv else controllers()).items()
    }
    if "stranger" in sys.argv:
        chosen["shelter-b"].append(Stranger(load_map("prostar-mppt"), device=9, address=3))
    asyncio.run(run(Path(sys.argv[1]), chosen, next((int(word) for word in sys.argv[2:] if word.isdigit()), None)))
