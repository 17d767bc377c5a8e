"""Lines of the gateway without a face: `line_growth.py FOLDER PERIOD_S SECONDS DEVICES_OF_LINE_0 DEVICES_OF_LINE_1…`.

Polls live blocks every PERIOD_S at 115200 baud. Prints one line of JSON: polls, seconds, CPU seconds and memory, from
the moment on when all devices are online and settled.
"""

from __future__ import annotations

import asyncio
import json
import sys
import time
from importlib.util import find_spec
from pathlib import Path

from gateway.clock import SystemClock
from gateway.core.settings import LineSettings, PollSettings
from gateway.core.site import Device
from gateway.core.snapshot import DeviceState
from gateway.devices.schema import load_map
from gateway.lines.serial import SerialLine

SETTLE_S = 2.0


def resident_mib() -> float:
    fields = dict(row.split(":", 1) for row in Path("/proc/self/status").read_text().splitlines())
    return int(fields["VmRSS"].split()[0]) / 1024


async def run(folder: Path, period_s: float, seconds: float, share: list[int]) -> None:
    device_map = load_map("prostar-mppt")
    poll = PollSettings(live_s=period_s, settings_s=3600.0)
    lines: list[SerialLine] = []
    devices: list[Device] = []
    for number, count in enumerate(share):
        unit = len(devices) + 1
        own = [Device(f"array-{unit + k}", unit + k, k + 1, device_map) for k in range(count)]
        settings = LineSettings(
            name=f"line{number}", index=number + 1, port=str(folder / f"line{number}"), baudrate=115200, poll=poll
        )
        lines.append(SerialLine(settings, own, SystemClock()))
        devices += own
    running = [asyncio.create_task(line.run()) for line in lines]
    while any(device.snapshot.state is not DeviceState.ONLINE for device in devices):  # noqa: ASYNC110  # no event tells
        await asyncio.sleep(0.1)
    await asyncio.sleep(SETTLE_S)
    began, used = time.monotonic(), time.process_time()
    polls = sum(line.stats.polls for line in lines)
    await asyncio.sleep(seconds)
    found = {
        "polls": sum(line.stats.polls for line in lines) - polls,
        "seconds": time.monotonic() - began,
        "cpu_s": time.process_time() - used,
        "rss_mib": resident_mib(),
    }
    sys.stdout.write(json.dumps(found) + "\n")
    for task in running:
        task.cancel()
    await asyncio.gather(*running, return_exceptions=True)


if __name__ == "__main__":
    work = run(Path(sys.argv[1]), float(sys.argv[2]), float(sys.argv[3]), [int(count) for count in sys.argv[4:]])
    if find_spec("uvloop"):
        import uvloop

        uvloop.run(work)
    else:
        asyncio.run(work)
