"""The cable to an upstream is dead: nothing comes back, and nobody is told. A real one, to a network namespace."""

from __future__ import annotations

import asyncio
import contextlib
import sys
from collections.abc import AsyncIterator

import pytest

from gateway.clock import SystemClock
from gateway.core.budget import GRACE_S
from gateway.core.settings import LineSettings, PollSettings, UpstreamSettings
from gateway.core.site import Device, LineState
from gateway.core.snapshot import DeviceState
from gateway.devices.schema import load_map
from gateway.lines.upstream import UpstreamLine
from gateway.simulator.device import SimulatedController
from gateway.simulator.tcp import TcpServer
from gateway.simulator.upstream import Habits, SimulatedServer
from tests.cable import Cable
from tests.lines.rig import until

PORT = 1502
TIMEOUT_S = 0.5
CONNECT_S = 0.5
SERVER = """
import asyncio, sys
from gateway.devices.schema import load_map
from gateway.simulator.device import SimulatedController
from gateway.simulator.tcp import TcpServer
from gateway.simulator.upstream import Habits, SimulatedServer

async def main(host, port, closes):
    unit = SimulatedController(load_map("tristar-mppt"))
    async with TcpServer(SimulatedServer([unit], habits=Habits(closes=closes)), host=host, port=port):
        print("listening", flush=True)
        await asyncio.Event().wait()

asyncio.run(main(sys.argv[1], int(sys.argv[2]), sys.argv[3] == "closes"))
"""


@contextlib.asynccontextmanager
async def running(host: str, port: int, device: Device) -> AsyncIterator[UpstreamLine]:
    upstream = UpstreamSettings(host, port, connect_timeout_s=CONNECT_S)
    poll = PollSettings(live_s=0.2, settings_s=60.0)
    settings = LineSettings(
        device.name, 1, f"tcp://{host}:{port}", reply_timeout_s=TIMEOUT_S, poll=poll, upstream=upstream
    )
    line = UpstreamLine(settings, [device], SystemClock())
    task = asyncio.create_task(line.run())
    try:
        yield line
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task


@contextlib.asynccontextmanager
async def far_server(cable: Cable, habit: str) -> AsyncIterator[None]:
    command = ("ip", "netns", "exec", cable.name, sys.executable, "-c", SERVER, cable.there, str(PORT), habit)
    server = await asyncio.create_subprocess_exec(*command, stdout=asyncio.subprocess.PIPE)
    assert server.stdout is not None
    try:
        async with asyncio.timeout(30):
            assert await server.stdout.readline() == b"listening\n"
        yield
    finally:
        server.kill()
        await server.wait()


@pytest.mark.parametrize("habit", ["keeps", "closes"])
@pytest.mark.peer
async def test_its_line_is_told_down_and_up_again_and_no_other_notices(cable: Cable, habit: str) -> None:
    tristar = load_map("tristar-mppt")
    far, near = Device("far", 11, 1, tristar), Device("near", 12, 1, tristar)
    clock = SystemClock()
    server = SimulatedServer([SimulatedController(tristar)], habits=Habits())
    async with (
        far_server(cable, habit),
        TcpServer(server) as here,
        running(cable.there, PORT, far) as line,
        running("127.0.0.1", here.port, near) as other,
    ):
        await until(lambda: far.snapshot.state is near.snapshot.state is DeviceState.ONLINE)
        before = other.stats.ok
        cable.cut()
        cut_at = clock.monotonic()
        await until(lambda: line.status(clock.monotonic()).state is LineState.DOWN)
        down_s = line.status(clock.monotonic()).since - cut_at
        assert down_s < 3 * (TIMEOUT_S + CONNECT_S + GRACE_S), "its time-outs, and a busy machine"
        assert far.snapshot.state is DeviceState.STALE
        assert far.snapshot.shown() == {}
        await until(lambda: other.stats.ok > before + 10)
        assert near.snapshot.state is DeviceState.ONLINE
        assert near.stats.went_offline == other.stats.failed["timeout"] == other.stats.failed["connection_lost"] == 0
        cable.mend()
        await until(lambda: far.snapshot.state is DeviceState.ONLINE)
        assert line.stats.opens == 2
