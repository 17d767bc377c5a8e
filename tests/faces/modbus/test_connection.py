"""The life of a connection: framing, limits, and how it ends."""

from __future__ import annotations

import asyncio
import errno
import socket

import pytest

from gateway.errors import ListenError
from gateway.faces.modbus.connection import MAX_WAITING, TURN
from gateway.modbus import mbap

from .conftest import GOOD, GOOD_REPLY, READ_1, Running, Serve, World


async def test_byte_by_byte(running: Running) -> None:
    running.world.poll(12)
    client = await running.connect()
    for byte in GOOD * 3:
        client.send(bytes((byte,)))
        await asyncio.sleep(0)
    assert await client.adus(3) == [mbap.Adu(1, 12, GOOD_REPLY[7:])] * 3


@pytest.mark.parametrize("cut", range(1, 24))
async def test_two_requests_cut_anywhere(running: Running, cut: int) -> None:
    running.world.poll(12)
    client = await running.connect()
    await client.query(12, READ_1)  # now it is found ready
    data = GOOD + GOOD
    client.send(data[:cut])
    await asyncio.sleep(0.001)
    client.send(data[cut:])
    assert await client.adus(2) == [mbap.Adu(1, 12, GOOD_REPLY[7:])] * 2


async def test_idle_connections_end(running: Running) -> None:
    running.world.poll(12)
    client = await running.connect()
    await client.query(12, READ_1)
    running.world.clock.now += 601.0
    running.server.sweep()
    assert await client.rest() == b""
    assert running.world.stats.closed == {"idle": 1}


async def test_a_request_that_nobody_answers_ends_its_connection(running: Running) -> None:
    running.world.line(12).held = True
    client = await running.connect()
    client.send(GOOD)
    await running.until(lambda: len(running.world.line(12).waiting) == 1)
    running.world.clock.now += 60.1
    running.server.sweep()
    running.world.line(12).release()  # too late, and before the transport has told anybody that it is closed
    assert await client.rest() == b""
    assert running.world.stats.closed == {"unanswered": 1}


async def test_a_flood_of_refusals_is_answered_in_turns(running: Running) -> None:
    """In one piece, as what a record of TLS held comes."""
    count = 5000
    client = await running.connect()
    await running.until(lambda: bool(running.server._connections))
    (connection,) = running.server._connections
    connection.data_received(b"".join(mbap.encode(tid, 12, b"\x08\0\0\0\0") for tid in range(count)))
    assert connection.client.requests == TURN, "now others have their turn"
    replies = await client.adus(count)
    assert replies == [mbap.Adu(tid, 12, b"\x88\x01") for tid in range(count)]


async def test_a_flooding_client_that_vanishes_between_two_turns(running: Running) -> None:
    world = running.world
    client, other = await running.connect(), await running.connect()
    client.send(mbap.encode(1, 12, b"\x08\0\0\0\0") * 20_000)
    await running.until(lambda: world.stats.requests > 0)
    client.reset()
    assert await other.query(12, READ_1) == GOOD_REPLY[7:]
    await running.until(lambda: world.stats.open_connections == 1)


async def test_an_error_while_a_reply_comes_ends_only_its_connection(
    running: Running, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    world = running.world
    client, other = await running.connect(), await running.connect()
    with monkeypatch.context() as patch:
        patch.setattr(running.server.dispatcher, "conclude", lambda *args: 1 / 0)
        client.send(GOOD)
        assert await client.rest() == b""
    assert await other.query(12, READ_1) == GOOD_REPLY[7:]
    assert world.stats.closed.pop("error") == 1
    assert "ZeroDivisionError" in caplog.text


async def test_an_error_nobody_foresaw_ends_only_its_connection(
    running: Running, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    world = running.world
    client, other = await running.connect(), await running.connect()
    with monkeypatch.context() as patch:
        patch.setattr(world.line(12), "read", lambda *args, **options: 1 / 0)
        client.send(GOOD)
        assert await client.rest() == b""
    assert await other.query(12, READ_1) == GOOD_REPLY[7:]
    assert world.stats.closed.pop("error") == 1
    assert "ZeroDivisionError" in caplog.text


async def test_stopping_lets_requests_under_way_finish(serve: Serve, world: World) -> None:
    running = await serve(stop_grace_s=10.0)
    line = world.line(12)
    line.held = True
    client, idle = await running.connect(), await running.connect()
    client.send(GOOD)
    await running.until(lambda: len(line.waiting) == 1)
    listener = running.server.listeners[0]
    address = running.address
    stop = asyncio.create_task(listener.stop())
    assert await idle.rest() == b""
    with pytest.raises(ConnectionRefusedError):
        await asyncio.open_connection(*address)
    client.send(GOOD)  # comes too late
    line.release()
    assert await client.rest() in {GOOD_REPLY, b""}
    await stop
    assert len(line.transactions) == 1
    assert listener.bound is None


async def test_stopping_answers_06_to_what_was_not_begun(serve: Serve, world: World) -> None:
    running = await serve(stop_grace_s=10.0)
    line = world.line(12)
    line.held = True
    client = await running.connect()
    asked = b"".join(mbap.encode(tid, 12, READ_1) for tid in range(MAX_WAITING + 9))
    client.send(asked)
    await running.until(lambda: bool(line.waiting) and len(line.waiting[0].waiters) == MAX_WAITING)
    stop = asyncio.create_task(running.server.listeners[0].stop())
    await asyncio.sleep(0)
    line.release()
    replies = mbap.MbapSplitter().feed(await client.rest())
    assert [reply.tid for reply in replies] == list(range(MAX_WAITING + 9))
    assert [reply.pdu for reply in replies] == [GOOD_REPLY[7:]] * MAX_WAITING + [b"\x83\x06"] * 9
    await stop
    assert world.stats.requests == MAX_WAITING + 9


async def test_stopping_does_not_wait_for_ever(serve: Serve, world: World) -> None:
    running = await serve(stop_grace_s=0.01)
    world.line(12).held = True
    client = await running.connect()
    client.send(GOOD)
    await running.until(lambda: len(world.line(12).waiting) == 1)
    await running.server.listeners[0].stop()
    assert await client.rest() == mbap.encode(1, 12, b"\x83\x06")
    assert not world.stats.closed


async def test_a_stopped_listener_starts_again(running: Running) -> None:
    listener = running.server.listeners[0]
    await listener.stop()
    await listener.start()
    client = await running.connect()
    assert await client.query(12, READ_1) == GOOD_REPLY[7:]


async def test_a_port_that_is_taken_is_named_and_tried_again(serve: Serve, world: World) -> None:
    with socket.create_server(("127.0.0.1", 0)) as holder:
        port = holder.getsockname()[1]
        with pytest.raises(ListenError, match=rf"modbus 127\.0\.0\.1:{port}: another program listens there"):
            await serve(listen=(("127.0.0.1", port),))
    running = await serve(listen=(("127.0.0.1", port),))
    assert running.server.listeners[0].label == f"modbus 127.0.0.1:{port}"
    assert running.address == ("127.0.0.1", port)


@pytest.mark.parametrize(
    ("host", "reason"),
    [("192.0.2.1", "this machine has no such address"), ("nowhere.invalid", "does not resolve")],
)
async def test_an_address_that_cannot_be_listened_on_says_why(serve: Serve, host: str, reason: str) -> None:
    with pytest.raises(ListenError, match=reason):
        await serve(listen=((host, 0),))


async def test_ipv6(serve: Serve) -> None:
    try:
        with socket.create_server(("::1", 0), family=socket.AF_INET6):
            pass
    except OSError as error:
        if error.errno not in {errno.EADDRNOTAVAIL, errno.EAFNOSUPPORT}:
            raise
        pytest.skip("this machine has no IPv6")
    running = await serve(listen=(("::1", 0),))
    assert running.server.listeners[0].label == "modbus [::1]:0"
    client = await running.connect()
    assert await client.query(12, READ_1) == GOOD_REPLY[7:]
