"""A recorded upstream answers again as it did, whoever asks under whatever transaction ids."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Mapping

import pytest

from gateway.clock import SystemClock
from gateway.core.settings import LineSettings, PollSettings, UpstreamSettings
from gateway.core.site import Device
from gateway.core.snapshot import DeviceState
from gateway.devices.model import Value
from gateway.lines.tap import Watcher
from gateway.lines.upstream import UpstreamLine
from gateway.modbus.mbap import encode
from gateway.modbus.recording import Piece, Recording
from gateway.simulator.oracle import OracleController
from gateway.simulator.replay_tcp import ReplayedConnection, ReplayedServer
from gateway.simulator.tcp import TcpServer
from gateway.simulator.upstream import Habits, SimulatedServer
from tests.faults.rig import oracle_map
from tests.lines.rig import until

ASK = bytes.fromhex("0300120001")
OTHER = bytes.fromhex("0300130001")
REPLY = bytes.fromhex("03021234")


def server(*pieces: tuple[float, str, bytes, int]) -> ReplayedServer:
    return ReplayedServer(Recording({}, tuple(Piece(at_s, way == ">", data, n) for at_s, way, data, n in pieces)))


def played(connection: ReplayedConnection, request: bytes, now: float) -> list[tuple[float, bytes, str]]:
    """What comes for a request, how long after it, and how the connection is then."""
    connection.receive(request, now)
    found = []
    while (at := connection.next_event()) is not None:
        found.append((round(at - now, 6), connection.take(at), connection.ended))
    return found


def test_an_answer_comes_to_the_unit_and_request_it_was_for_whatever_their_order() -> None:
    one = server(
        (1.0, ">", encode(7, 1, ASK) + encode(8, 2, ASK), 0),
        (1.2, "<", encode(8, 2, REPLY)[:5], 0),
        (1.3, "<", encode(8, 2, REPLY)[5:] + encode(7, 1, b"\x83\2"), 0),
    )
    connection = one.connect()
    assert played(connection, encode(500, 1, ASK), 100.0) == [(0.3, encode(500, 1, b"\x83\2"), "")]
    assert played(connection, encode(501, 2, ASK), 101.0) == [(0.3, encode(501, 2, REPLY), "")]
    assert played(connection, encode(502, 3, ASK), 102.0) == []
    assert (one.requests, one.answered, one.unknown) == (2, 2, 1)


def test_a_connection_is_closed_where_it_was() -> None:
    one = server(
        (1.0, ">", encode(7, 1, ASK), 3),
        (1.1, "<", encode(7, 1, REPLY), 3),
        (1.2, "<", b"", 3),
        (2.0, ">", encode(8, 1, ASK), 3),
        (2.5, "<", b"", 3),
        (3.0, ">", encode(9, 1, ASK), 3),
        (9.0, ">", b"", 3),
    )
    assert played(one.connect(), encode(1, 1, ASK), 100.0) == [(0.1, encode(1, 1, REPLY), "fin")]
    assert played(one.connect(), encode(1, 1, ASK), 100.0) == [(0.5, b"", "fin")]
    assert played(one.connect(), encode(1, 1, ASK), 100.0) == []
    assert played(one.connect(), encode(1, 1, ASK), 100.0) == [(0.1, encode(1, 1, REPLY), "fin")]


def test_connections_do_not_mix() -> None:
    one = server(
        (1.0, ">", encode(7, 1, ASK), 0),
        (1.0, ">", encode(7, 1, OTHER), 1),
        (1.1, "<", encode(7, 1, REPLY), 1),
        (1.2, "<", b"noise", 0),
        (1.3, "<", b"", 0),
    )
    assert played(one.connect(), encode(1, 1, OTHER), 0.0) == [(0.1, encode(1, 1, REPLY), "")]
    assert played(one.connect(), encode(1, 1, ASK), 0.0) == [(0.3, b"", "fin")]


@pytest.mark.parametrize(("closes", "connections"), [(False, 1), (True, 1), (True, 4)])
async def test_a_gateway_finds_in_the_recording_what_it_found_in_the_server(closes: bool, connections: int) -> None:
    units = [OracleController(oracle_map(), device=k, address=k, turnaround_s=0.002) for k in (1, 2)]
    pieces: list[Piece] = []

    def watch(now: float, sent: bool, data: bytes, connection: int) -> None:
        pieces.append(Piece(now, sent, data, connection))

    async with TcpServer(SimulatedServer(units, habits=Habits(closes=closes))) as real:
        before = await _values(real.port, connections, watch)
    recording = Recording.parse(['{"format": "prostar-gateway line recording 1"}', *(piece.line() for piece in pieces)])
    replayed = ReplayedServer(recording)
    async with TcpServer(replayed) as again:
        assert await _values(again.port, connections) == before
    assert replayed.unknown == 0


async def _values(port: int, connections: int, watch: Watcher | None = None) -> list[Mapping[str, Value]]:
    """What two controllers show once they are online."""
    devices = [Device(f"array-{k}", k, k, oracle_map()) for k in (1, 2)]
    upstream = UpstreamSettings("127.0.0.1", port, connections=connections)
    poll = PollSettings(live_s=0.3, settings_s=60.0)
    line = UpstreamLine(LineSettings("far", 1, "", poll=poll, upstream=upstream), devices, SystemClock())
    if watch is not None:
        line.tap.open(watch)
    task = asyncio.create_task(line.run())
    try:
        await until(lambda: all(len(device.snapshot.blocks) >= 3 for device in devices))
        await until(lambda: all(device.snapshot.state is DeviceState.ONLINE for device in devices))
        return [device.snapshot.values for device in devices]
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task
