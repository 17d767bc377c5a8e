"""The history in the real gateway: a process over a simulated line, killed by a signal, read by API and command."""

from __future__ import annotations

import asyncio
import json
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from aiohttp import ClientError, ClientSession

from gateway.devices.log import decode_log, split_blocks
from gateway.devices.model import Space
from gateway.modbus.rtu import Timing
from gateway.simulator.device import SimulatedController
from gateway.simulator.line import SimulatedLine
from gateway.simulator.pty import PtyLine
from tests.history.blocks import LAYOUT, MAP

REPOSITORY = Path(__file__).parents[2]
GATEWAY = (sys.executable, "-m", "gateway")
BAUDRATE = 115200
CONFIG = """
site = "ridge-07"
state_dir = "{folder}/state"
[[line]]
name = "shelter-a"
port = "{folder}/line"
baudrate = {baudrate}
[[line.device]]
name = "array-1"
address = 1
unit_id = 11
model = "prostar-mppt"
[modbus]
listen = []
[snmp]
listen = []
[http]
listen = ["127.0.0.1:{port}"]
"""


def days_of(controller: SimulatedController) -> dict[int, str]:
    """Hourmeter → words of the days in the ring, in hexadecimal."""
    words = controller.memory.read(Space.REGISTERS, LAYOUT.first, LAYOUT.blocks * LAYOUT.block_words)
    ring = split_blocks(LAYOUT, b"".join(word.to_bytes(2, "big") for word in words))
    return {day.hourmeter: ring[day.slot].hex() for day in decode_log(LAYOUT, ring).days}


async def log(url: str, days: int) -> list[dict[str, object]]:
    """The log as soon as it has so many days."""
    async with ClientSession() as session, asyncio.timeout(60):
        while True:
            try:
                async with session.get(f"{url}/api/v1/log") as reply:
                    if reply.status == 200 and len(found := (await reply.json())["days"]) == days:
                        return list(found)
            except ClientError:
                pass
            await asyncio.sleep(0.05)


def command(config: Path) -> list[dict[str, object]]:
    """What `log` prints."""
    arguments = [*GATEWAY, "log", "-c", str(config), "--format", "jsonl"]
    done = subprocess.run(arguments, cwd=REPOSITORY, capture_output=True, text=True, check=True)
    assert done.stderr == ""
    return [json.loads(line) for line in done.stdout.splitlines()]


async def test_a_gateway_keeps_the_days_of_its_controllers(tmp_path: Path, free_tcp_port: Callable[[], int]) -> None:
    port = free_tcp_port()
    config = tmp_path / "site.toml"
    config.write_text(CONFIG.format(folder=tmp_path, baudrate=BAUDRATE, port=port))
    controller = SimulatedController(MAP, seed=0, turnaround_s=0.004)
    line = SimulatedLine([controller], timing=Timing.of(BAUDRATE, 8, "N", 2))
    async with PtyLine(line, link=tmp_path / "line"):
        gateway = await asyncio.create_subprocess_exec(
            *(*GATEWAY, "run", "-c", str(config)), cwd=REPOSITORY, stderr=asyncio.subprocess.PIPE
        )
        try:
            days = await log(f"http://127.0.0.1:{port}", 256)
            assert {day["hourmeter_hours"]: day["words"] for day in days} == days_of(controller)
            assert await asyncio.to_thread(command, config) == days  # while the gateway runs
            async with ClientSession() as session, session.get(f"http://127.0.0.1:{port}/metrics") as reply:
                metrics = await reply.text()
        finally:
            gateway.send_signal(signal.SIGTERM)
            _, said = await gateway.communicate()
    assert gateway.returncode == 0
    assert 'prostar_gateway_history_blocks{device="array-1"' in metrics
    assert "_daily_" not in metrics
    assert b"event=history_harvested" in said
    assert b"level=error" not in said
    assert await asyncio.to_thread(command, config) == days  # and afterwards
