"""Modbus TCP upstreams over real sockets: connections, their ends, and what becomes of the line."""

from __future__ import annotations

import asyncio
import logging
import socket
import time
from typing import Any

import pytest

from gateway.clock import SystemClock
from gateway.core.settings import LineSettings, PollSettings, UpstreamSettings
from gateway.core.site import Device, LineState
from gateway.core.snapshot import DeviceState
from gateway.devices.plan import poll_plan
from gateway.devices.schema import load_map
from gateway.errors import LineDown
from gateway.lines.upstream import UpstreamLine
from gateway.simulator.oracle import OracleController
from gateway.simulator.tcp import TcpServer
from gateway.simulator.upstream import Habits, SimulatedServer
from tests.faults.rig import oracle_map
from tests.lines.rig import SleepingClock, ask, lag_meter, running, until
from tests.machine import Stopwatch
from tests.optional import optional

FAST = PollSettings(live_s=0.2, settings_s=60.0)


def controllers(count: int) -> list[OracleController]:
    return [OracleController(oracle_map(), device=k, address=k + 1, turnaround_s=0.002) for k in range(count)]


def devices(count: int) -> list[Device]:
    return [Device(f"array-{k}", 10 + k, k + 1, oracle_map()) for k in range(count)]


def line_to(host: str, port: int, units: list[Device], **settings: Any) -> UpstreamLine:
    upstream = UpstreamSettings(
        host,
        port,
        pipelining=settings.pop("pipelining", 8),
        connections=settings.pop("connections", 1),
        connect_timeout_s=settings.pop("connect_timeout_s", 2.0),
    )
    settings = {"poll": FAST, "reply_timeout_s": 0.3, **settings}
    where = f"tcp://{host}:{port}"
    return UpstreamLine(LineSettings("site-a", 1, where, upstream=upstream, **settings), units, SystemClock())


def state(line: UpstreamLine) -> LineState:
    return line.status(SystemClock().monotonic()).state


def all_online(units: list[Device]) -> bool:
    return all(device.snapshot.state is DeviceState.ONLINE for device in units)


@pytest.mark.parametrize("host", ["127.0.0.1", "::1", "localhost"])
async def test_values_come_over_ipv4_ipv6_and_by_name(host: str) -> None:
    units = devices(3)
    listen = "127.0.0.1" if host == "localhost" else host
    async with (
        TcpServer(SimulatedServer(controllers(3)), host=listen) as server,
        running(line_to(host, server.port, units)) as line,
    ):
        await until(lambda: all_online(units))
        assert line.stats.upstream is not None
        assert line.stats.upstream.connections == 1
        assert server.server.counters.most_waiting > 1, "requests are pipelined"


def test_it_runs_on_uvloop() -> None:
    uvloop = optional("uvloop")
    for habits in (Habits(), Habits(closes=True)):
        uvloop.run(online_once(habits))


async def online_once(habits: Habits) -> None:
    units = devices(2)
    server = TcpServer(SimulatedServer(controllers(2), habits=habits))
    async with server, running(line_to("127.0.0.1", server.port, units)) as line:
        await until(lambda: all_online(units))
        for k in range(10):
            assert isinstance(await ask(line, units[k % 2], 0, 10), bytes)


async def test_a_server_that_closes_after_every_reply_gives_no_error_and_no_pause() -> None:
    units = devices(2)
    simulated = SimulatedServer(controllers(2), habits=Habits(closes=True))
    async with TcpServer(simulated) as server, running(line_to("127.0.0.1", server.port, units)) as line:
        await until(lambda: all_online(units))
        watch = Stopwatch()
        for k in range(30):
            assert isinstance(await ask(line, units[k % 2], 0, 10), bytes)
        assert watch.s < 3.0
        assert set(line.stats.failed) <= {"exception"}, "its habit is learnt without losing a request"
        assert line.stats.upstream is not None
        assert set(line.stats.upstream.lost) == {"finished"}
        assert line.stats.opens == 1
        assert simulated.counters.most_open <= 2, "the next may come in before the last is gone"
        await until(lambda: simulated.counters.open_connections <= 1)
        assert all_online(units)


async def test_a_server_that_closes_is_asked_over_several_connections_at_once() -> None:
    units = devices(3)
    simulated = SimulatedServer(controllers(3), habits=Habits(closes=True))
    async with (
        TcpServer(simulated) as server,
        running(line_to("127.0.0.1", server.port, units, connections=4)) as line,
    ):
        await until(lambda: all_online(units))
        for _ in range(10):
            replies = await asyncio.gather(*(ask(line, units[k % 3], 5 * k, 5) for k in range(12)))
            assert all(isinstance(reply, bytes) and reply[0] == 3 for reply in replies)
        assert 1 < simulated.counters.most_open <= 8, "the next may come in before the last is gone"
        assert set(line.stats.failed) <= {"exception"}


async def test_a_further_connection_that_is_not_to_be_had_is_done_without() -> None:
    units = devices(2)
    simulated = SimulatedServer(controllers(2), habits=Habits(latency_s=0.01, admits=1))
    async with TcpServer(simulated) as server:
        line = line_to("127.0.0.1", server.port, units, connections=4, pipelining=1)
        async with running(line):
            await until(lambda: all_online(units))
            for _ in range(20):
                replies = await asyncio.gather(*(ask(line, units[k % 2], 10 * k, 10) for k in range(6)))
                assert all(isinstance(reply, bytes) for reply in replies)
            assert line.stats.opens == 1
            assert line.stats.upstream is not None
            assert line.stats.upstream.connections < 10, "it is not stormed"


async def test_a_refused_connection_takes_the_line_down_and_it_recovers_alone(
    caplog: pytest.LogCaptureFixture,
) -> None:
    units = devices(1)
    caplog.set_level(logging.INFO)
    server = TcpServer(SimulatedServer(controllers(1)))
    async with server, running(line_to("127.0.0.1", server.port, units)) as line:
        await until(lambda: all_online(units))
        server.close()
        await until(lambda: state(line) is LineState.DOWN)
        assert units[0].snapshot.state is DeviceState.STALE
        assert isinstance(await ask(line, units[0], 0, 10), LineDown)
        assert "connection refused" in line.status(0.0).error
        await server.open()
        await until(lambda: all_online(units))
        said = [record.message for record in caplog.records if "event=line_" in record.message]
        assert len([text for text in said if "event=line_down" in text]) == 1


async def test_a_cut_connection_is_followed_by_the_next_and_nobody_notices() -> None:
    units = devices(2)
    async with (
        TcpServer(SimulatedServer(controllers(2))) as server,
        running(line_to("127.0.0.1", server.port, units)) as line,
    ):
        await until(lambda: all_online(units))
        for _ in range(5):
            server.cut()
            assert isinstance(await ask(line, units[0], 0, 10), bytes)
        assert line.stats.opens == 1
        assert all_online(units)


async def test_a_name_that_nobody_knows_is_said_and_costs_the_loop_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    def slow(*_: object, **__: object) -> list[object]:
        time.sleep(0.4)
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", slow)
    line = line_to("no-such-host.invalid", 502, devices(1), connect_timeout_s=0.1)
    async with lag_meter() as lag, running(line):
        await until(lambda: "within 0.1 s" in line.status(0.0).error)
        await until(lambda: "is not known" in line.status(0.0).error)
    assert lag.worst_s < 0.2


async def test_a_server_that_does_not_answer_the_connection_attempt_is_given_up() -> None:
    with socket.create_server(("127.0.0.1", 0), backlog=0) as full:
        port = full.getsockname()[1]
        waiting = [socket.socket() for _ in range(4)]
        for sock in waiting:
            sock.setblocking(False)
            sock.connect_ex(("127.0.0.1", port))
        async with running(line_to("127.0.0.1", port, devices(1), connect_timeout_s=0.2)) as line:
            await until(lambda: "no answer to the connection attempt" in line.status(0.0).error)
        for sock in waiting:
            sock.close()


async def test_a_server_that_closes_at_once_is_no_line_and_is_not_stormed() -> None:
    simulated = SimulatedServer([])
    simulated.refusing = True
    async with TcpServer(simulated) as server, running(line_to("127.0.0.1", server.port, devices(1))) as line:
        await until(lambda: "closes connections at once" in line.status(0.0).error)
        assert state(line) is LineState.DOWN
        assert line.stats.upstream is not None
        before = line.stats.upstream.connections
        await asyncio.sleep(0.5)
        assert line.stats.upstream.connections - before < 10


async def test_a_silent_server_is_dropped_and_the_loop_is_free() -> None:
    units = devices(1)
    simulated = SimulatedServer([], habits=Habits(silence=None))
    async with (
        TcpServer(simulated) as server,
        lag_meter() as lag,
        running(line_to("127.0.0.1", server.port, units, reply_timeout_s=0.05)) as line,
    ):
        await until(lambda: units[0].snapshot.state is DeviceState.OFFLINE)
        assert line.stats.upstream is not None
        assert line.stats.upstream.lost["timeout"] >= 2
    assert lag.worst_s < 0.3


async def test_the_prostar_map_is_served_by_a_real_server() -> None:
    from gateway.simulator.device import SimulatedController

    device_map = load_map("prostar-mppt")
    unit = Device("array-1", 11, 1, device_map)
    async with (
        TcpServer(SimulatedServer([SimulatedController(device_map)])) as server,
        running(line_to("127.0.0.1", server.port, [unit])),
    ):
        await until(lambda: unit.snapshot.state is DeviceState.ONLINE)
        assert 11 < unit.snapshot.shown()["battery_voltage"] < 15


async def test_after_the_machine_slept_an_upstream_is_read_anew_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Although the next poll is an hour of timers away."""
    monkeypatch.setattr("gateway.lines.upstream.LONGEST_ALARM_S", 0.05)
    clock, units = SleepingClock(), devices(2)
    seldom = PollSettings(live_s=3600.0, settings_s=3600.0)
    async with TcpServer(SimulatedServer(controllers(2))) as server:
        where = UpstreamSettings("127.0.0.1", server.port)
        settings = LineSettings("site-a", 1, server.url, reply_timeout_s=0.3, poll=seldom, upstream=where)
        async with running(UpstreamLine(settings, units, clock)):
            await until(lambda: all(len(unit.snapshot.blocks) == len(poll_plan(unit.map)) for unit in units))
            looks = clock.looks
            await until(lambda: clock.looks > looks + 20)  # although there is nothing to do
            clock.slept_s = 8 * 3600.0
            woke_at = clock.monotonic()
            await until(lambda: all(at >= woke_at for unit in units for at in unit.snapshot.read_at.values()))
            assert all_online(units)
