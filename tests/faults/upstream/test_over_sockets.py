"""The same chaos on real sockets, through the shell that owns the connection: no wrong value, and it recovers."""

from __future__ import annotations

import asyncio
import contextlib
from random import Random

import pytest

from gateway.clock import SystemClock
from gateway.core.settings import LineSettings, PollSettings, UpstreamSettings
from gateway.core.site import Device, Outcome
from gateway.core.snapshot import DeviceState
from gateway.lines.upstream import UpstreamLine
from gateway.modbus.pdu import is_exception
from gateway.simulator.oracle import Verdict
from gateway.simulator.tcp import TcpServer
from gateway.simulator.tcp_chaos import EXCEPTIONS, TcpChaos, TcpFault
from gateway.simulator.upstream import Habits, SimulatedServer
from tests.faults.rig import Unit, oracle_map, read
from tests.faults.upstream.rig import COUNTS, FIRSTS
from tests.lines.rig import until

READS = 120


@pytest.mark.parametrize(("closes", "connections"), [(False, 1), (False, 3), (True, 1), (True, 4)])
async def test_no_wrong_value(closes: bool, connections: int) -> None:
    habits = Habits(closes=closes)
    chaos = TcpChaos(5, dict.fromkeys(TcpFault, 0.01), delay_s=(0.005, 0.03), late_s=(0.2, 0.5))
    units = [Unit(0, turnaround_s=0.001), Unit(1, turnaround_s=0.001)]
    devices = [Device(f"array-{n}", 10 + n, unit.address, oracle_map()) for n, unit in enumerate(units, 1)]
    rng = Random(5)
    async with TcpServer(SimulatedServer(units, habits=habits, spoiler=chaos)) as server:
        upstream = UpstreamSettings("127.0.0.1", server.port, connections=connections)
        poll = PollSettings(live_s=0.3, settings_s=2.0)
        settings = LineSettings("line", 1, server.url, reply_timeout_s=0.15, poll=poll, upstream=upstream)
        line = UpstreamLine(settings, devices, SystemClock(), Random(1))
        running = asyncio.create_task(line.run())
        try:
            await until(lambda: line.stats.ok > 5)
            outcomes = await asyncio.gather(*(_ask(line, units, devices, rng, k) for k in range(READS)))
            assert sum(outcomes) > READS // 3
            chaos.stop()
            await until(lambda: all(device.snapshot.state is DeviceState.ONLINE for device in devices), 20.0)
        finally:
            running.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await running
    stats = line.stats
    assert stats.sent == stats.ok + stats.failed.total()
    assert sum(chaos.counts.values()) > 10


async def _ask(line: UpstreamLine, units: list[Unit], devices: list[Device], rng: Random, number: int) -> bool:
    """One read, judged; whether it brought data."""
    await asyncio.sleep(0.01 * number)
    which = rng.randrange(len(units))
    pdu = read(rng.choice(FIRSTS), rng.choice(COUNTS))
    done: asyncio.Future[Outcome] = asyncio.get_running_loop().create_future()
    asked_at = SystemClock().monotonic()
    line.read(devices[which], pdu, done.set_result, client=f"client-{number % 3}")
    async with asyncio.timeout(30):
        outcome = await done
    if not isinstance(outcome, bytes) or (is_exception(outcome) and outcome[1] in EXCEPTIONS.values()):
        return False
    assert units[which].judge_reply(pdu, outcome, asked_at=asked_at) is Verdict.RIGHT
    return True
