"""Simulated lines in a process of their own: `line_simulator.py FOLDER BAUDRATE CHAOS_PERCENT LINE=ADDRESSES…`.

Controllers without turnaround, so that what is measured is the client. Registers 0 and 1 hold the milliseconds of
CLOCK_MONOTONIC at which they were read, so that whoever gets them knows how old they are; register i of address a
holds a << 8 | i elsewhere. ADDRESSES is `1,2,3` or `1-16`; `!7` never answers. Makes FOLDER/LINE, prints one line when
all are there, and at SIGTERM one line of JSON: what each line saw since SIGUSR1. Runs before everything else where it
may, so that its pacing is the line's and not the machine's.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import signal
import sys
import time
from dataclasses import asdict
from pathlib import Path

from gateway.devices.model import Space
from gateway.devices.schema import load_map
from gateway.modbus.rtu import Timing
from gateway.simulator.chaos import Chaos, all_at
from gateway.simulator.line import LineCounters, SimulatedLine
from gateway.simulator.medium import CleanMedium, Medium
from gateway.simulator.oracle import OracleController
from gateway.simulator.pty import PtyLine

PRIORITY = 20


class Clock(OracleController):
    """Tells when it was read, and who it is."""

    def read(self, space: Space, first: int, count: int, now: float) -> list[int]:
        super().read(space, first, count, now)  # its refusals
        if space is not Space.REGISTERS:
            return [0] * count
        held = int(now * 1000) & 0xFFFF_FFFF
        words = {0: held >> 16, 1: held & 0xFFFF}
        return [words.get(at, self.address << 8 | at & 0xFF) for at in range(first, first + count)]


def stations(listed: str) -> list[Clock]:
    """The controllers of one line."""
    made: list[Clock] = []
    for part in listed.split(","):
        first, _, last = part.removeprefix("!").partition("-")
        for address in range(int(first), int(last or first) + 1):
            station = Clock(load_map("prostar-mppt"), device=len(made) % 15, address=address, turnaround_s=0.0)
            station.silent = part.startswith("!")
            made.append(station)
    return made


def lines(folder: Path, baudrate: int, chaos_percent: float, plans: list[str]) -> list[PtyLine]:
    timing = Timing.of(baudrate, 8, "N", 2)
    made = []
    for number, plan in enumerate(plans):
        name, _, listed = plan.partition("=")
        medium: Medium = Chaos(number, all_at(chaos_percent / 100)) if chaos_percent else CleanMedium()
        line = SimulatedLine(stations(listed), timing=timing, medium=medium)
        made.append(PtyLine(line, link=folder / name))
    return made


async def run(made: list[PtyLine]) -> None:
    stop = asyncio.Event()
    began = time.monotonic()

    def begin() -> None:
        nonlocal began
        began = time.monotonic()
        for line in made:
            line.line.counters = LineCounters()

    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, stop.set)
    asyncio.get_running_loop().add_signal_handler(signal.SIGUSR1, begin)
    for line in made:
        line.open()
    sys.stdout.write("open\n")
    sys.stdout.flush()
    await stop.wait()
    elapsed_s = time.monotonic() - began
    seen = [{**asdict(line.line.counters), "use": line.line.use_ratio(elapsed_s)} for line in made]
    sys.stdout.write(json.dumps(seen) + "\n")
    for line in made:
        line.close()


if __name__ == "__main__":
    with contextlib.suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    asyncio.run(run(lines(Path(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3]), sys.argv[4:])))
