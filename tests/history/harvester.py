"""A gateway's line and history, and nothing else: reads a port until it is killed. For test_kill.py.

python -m tests.history.harvester PORT DIRECTORY
"""

from __future__ import annotations

import asyncio
import sys
from pathlib import Path

from gateway.clock import SystemClock
from gateway.core.settings import LineSettings, PollSettings
from gateway.core.site import Device, Site
from gateway.core.stats import HistoryStats
from gateway.devices.schema import load_map
from gateway.history.keeper import HistoryKeeper
from gateway.history.settings import HistorySettings
from gateway.lines.serial import SerialLine

BAUDRATE = 115200


def say(text: str) -> None:
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


async def run(port: str, directory: Path) -> None:
    clock = SystemClock()
    device = Device("array-1", 11, 1, load_map("prostar-mppt"))
    settings = LineSettings("shelter-a", 1, port, baudrate=BAUDRATE, poll=PollSettings(live_s=30.0))
    line = SerialLine(settings, [device], clock)
    stats = HistoryStats()
    keeper = HistoryKeeper(
        HistorySettings(directory),
        Site.of("ridge-07", [line], [device]),
        clock,
        stats,
        sleep=lambda seconds: asyncio.sleep(min(seconds, 0.05)),
    )
    async with asyncio.TaskGroup() as group:
        group.create_task(line.run())
        group.create_task(keeper.run())
        say("started")
        while not stats.devices[11].harvests:  # noqa: ASYNC110  # counters have no event
            await asyncio.sleep(0.01)
        say("harvested")


if __name__ == "__main__":
    asyncio.run(run(sys.argv[1], Path(sys.argv[2])))
