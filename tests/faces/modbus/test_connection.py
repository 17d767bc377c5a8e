"""The life of a connection: framing, limits, and how it ends."""

from __future__ import annotations

import asyncio
import errno
import socket
import struct

import pytest

from gateway.errors import ListenError
from gateway.faces.modbus.connection import MAX_WAITING
from gateway.modbus import mbap

from .conftest import Running, Serve, World, registers

READ_1 = bytes.fromhex("03 0000 0001")
GOOD = mbap.encode(1, 12, READ_1)
GOOD_REPLY = mbap.encode(1, 12, b"\x03\x02" + registers(2, 0, 1))


def foreign(protocol: int = 1) -> bytes:
    return b"\x00\x09" + protocol.to_bytes(2) + b"\x00\x06\x0c" + READ_1


async def test_f27_foreign_protocol_is_skipped_and_counted(running: Running) -> None:
    client = await running.connect()
    for _ in range(3):  # never three in a row
        client.send(foreign() + foreign(0xFFFF) + GOOD)
        assert await client.adu() == mbap.Adu(1, 12, GOOD_REPLY[7:])
    assert running.world.stats.malformed == {"protocol_id": 6}


async def test_f27_answers_between_do_not_add_up_to_three_in_a_row(running: Running) -> None:
    running.world.poll(12)
    client = await running.connect()
    for _ in range(5):
        client.send(foreign())
        for _ in range(3):  # the later ones are found ready
            assert await client.query(12, READ_1) == GOOD_REPLY[7:]
    assert running.world.stats.closed["framing_lost"] == 0


async def test_f27_three_in_a_row_end_the_connection(running: Running) -> None:
    client = await running.connect()
    client.send(GOOD + foreign() * 3 + GOOD)
    assert await client.rest() == GOOD_REPLY
    assert running.world.stats.closed == {"framing_lost": 1}


@pytest.mark.parametrize("length", [0, 1, 255, 256, 65535])
async def test_f28_a_wrong_length_ends_the_connection_after_what_came_before(running: Running, length: int) -> None:
    line = running.world.line(12)
    line.held = True
    client = await running.connect()
    client.send(GOOD + struct.pack(">HHHB", 2, 0, length, 11) + READ_1 + GOOD)
    await running.until(lambda: len(line.waiting) == 1)
    line.release()
    assert await client.rest() == GOOD_REPLY
    assert line.transactions == [(2, READ_1)], "nothing after the loss is executed"
    assert running.world.stats.malformed == {"framing_length": 1}


@pytest.mark.parametrize("pdu", [b"\x03", b"\x03\0\0\0", READ_1 + b"\0", READ_1 * 50, b"\x01\0\0\0\0\0"])
async def test_f29_a_pdu_of_the_wrong_length_is_03_and_the_next_request_is_right(running: Running, pdu: bytes) -> None:
    client = await running.connect()
    client.send(mbap.encode(5, 12, pdu) + GOOD)
    assert await client.adus(2) == [mbap.Adu(5, 12, bytes((pdu[0] | 0x80, 3))), mbap.Adu(1, 12, GOOD_REPLY[7:])]


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


async def test_f30_half_a_request_must_be_completed_in_time(running: Running) -> None:
    world = running.world
    world.poll(12)
    slow, other = await running.connect(), await running.connect()
    slow.send(GOOD[:-1])
    await other.query(12, READ_1)
    world.clock.now += 5.0
    running.server.sweep()
    assert world.stats.open_connections == 2
    world.clock.now += 0.1
    running.server.sweep()
    assert await slow.rest() == b""
    assert world.stats.closed == {"slow_frame": 1}
    assert await other.query(12, READ_1)


async def test_f30_a_request_that_the_server_itself_left_half_read_is_not_late(running: Running) -> None:
    world = running.world
    line = world.line(12)
    line.held = True
    client = await running.connect()
    client.send(GOOD * 200)
    await running.until(lambda: bool(line.waiting) and len(line.waiting[0].waiters) == MAX_WAITING)
    connection = next(iter(running.server._connections))
    assert connection._splitter.pending, "the cut of the first piece went through a request"
    world.clock.now += 6.0
    running.server.sweep()
    line.held = False
    line.release()
    assert await client.adus(200) == [mbap.Adu(1, 12, GOOD_REPLY[7:])] * 200
    assert not world.stats.closed


async def test_f31_a_client_that_takes_no_replies_is_paused_then_cut_off(running: Running) -> None:
    world = running.world
    world.poll(12)
    client = await running.connect()
    sock = client.writer.get_extra_info("socket")
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    client.reader._transport.pause_reading()  # type: ignore[attr-defined]
    burst = mbap.encode(1, 12, bytes.fromhex("03 0000 0050")) * 1000
    connection = next(iter(running.server._connections))
    async with asyncio.timeout(10):
        while connection._unsent_since is None:
            client.send(burst)
            await asyncio.sleep(0.001)
    asked = world.stats.requests
    assert connection._transport is not None
    assert connection._transport.get_write_buffer_size() < 64 * 1024
    client.send(burst)
    await asyncio.sleep(0.01)
    assert world.stats.requests == asked, "nothing more is looked at"
    world.clock.now += 10.1
    running.server.sweep()
    await running.until(lambda: world.stats.open_connections == 0)
    assert world.stats.closed == {"not_reading": 1}


async def test_a_client_that_takes_its_replies_late_gets_them_all(running: Running) -> None:
    running.world.poll(12)
    client = await running.connect()
    client.reader._transport.pause_reading()  # type: ignore[attr-defined]
    connection = next(iter(running.server._connections))
    count = 0
    async with asyncio.timeout(10):
        while connection._unsent_since is None:
            client.send(mbap.encode(1, 12, bytes.fromhex("03 0000 0050")) * 1000)
            count += 1000
            await asyncio.sleep(0.001)
    client.reader._transport.resume_reading()  # type: ignore[attr-defined]
    reply = mbap.encode(1, 12, b"\x03\xa0" + registers(2, 0, 80))
    async with asyncio.timeout(30):
        assert await client.reader.readexactly(count * len(reply)) == reply * count
    assert running.world.stats.cache_hits == count


async def test_f34_half_closed_client_still_gets_its_replies(running: Running) -> None:
    line = running.world.line(12)
    line.held = True
    client = await running.connect()
    client.send(GOOD * 3)
    client.writer.write_eof()
    await running.until(lambda: bool(line.waiting) and len(line.waiting[0].waiters) == 3)
    line.release()
    assert await client.rest() == GOOD_REPLY * 3


async def test_half_closed_idle_client_is_closed(running: Running) -> None:
    client = await running.connect()
    client.writer.write_eof()
    assert await client.rest() == b""


async def test_f34_reset_with_requests_under_way(running: Running) -> None:
    world = running.world
    line = world.line(12)
    line.held = True
    client = await running.connect()
    client.send(GOOD + mbap.encode(2, 11, READ_1))
    await running.until(lambda: len(line.waiting) == 2)
    client.reset()
    await running.until(lambda: world.stats.open_connections == 0)
    assert all(ticket.done is None for read in line.waiting for ticket in read.waiters), "withdrawn"
    line.release()
    other = await running.connect()
    line.held = False
    assert await other.query(12, READ_1) == GOOD_REPLY[7:]


async def test_f32_the_longest_idle_connection_makes_room(serve: Serve, world: World) -> None:
    running = await serve(max_connections=2)
    world.poll(12)
    world.line(11).held = True
    first, second = await running.connect(), await running.connect()
    await first.query(12, READ_1)
    world.clock.now += 1.0
    await second.query(12, READ_1)
    world.clock.now += 10.0
    world.poll(12)
    third = await running.connect()
    assert await third.query(12, READ_1) == GOOD_REPLY[7:]
    assert await first.rest() == b""
    assert world.stats.closed == {"evicted": 1}
    assert world.stats.open_connections == 2
    assert await second.query(12, READ_1) == GOOD_REPLY[7:]


async def test_f32_connections_at_work_are_not_evicted(serve: Serve, world: World) -> None:
    running = await serve(max_connections=2)
    world.poll(12)
    world.line(11).held = True
    waiting, busy = await running.connect(), await running.connect()
    waiting.ask(1, 11, READ_1)
    await running.until(lambda: len(world.line(11).waiting) == 1)
    world.clock.now += 30.0
    world.poll(12)
    await busy.query(12, READ_1)
    newcomer = await running.connect()
    assert await newcomer.rest() == b""
    assert world.stats.refused_connections == 1
    world.line(11).release()
    assert (await waiting.adu()).pdu[0] == 3
    assert await busy.query(12, READ_1) == GOOD_REPLY[7:]


async def test_f49_an_address_that_is_not_allowed_is_cut_off_unread(
    serve: Serve, world: World, caplog: pytest.LogCaptureFixture
) -> None:
    from ipaddress import ip_network

    running = await serve(allow=(ip_network("127.0.0.2/32"),))
    for _ in range(3):
        stranger = await running.connect()
        stranger.send(GOOD)
        assert await stranger.rest() == b""
    friend = await running.connect(local_addr=("127.0.0.2", 0))
    assert await friend.query(12, READ_1) == GOOD_REPLY[7:]
    assert world.stats.requests == 1
    assert world.stats.refused_connections == 3
    lines = [record for record in caplog.records if "connection_refused" in record.getMessage()]
    assert len(lines) == 1


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
    count = 5000  # far more than one turn; one write, so that few reads take it
    client = await running.connect()
    client.send(b"".join(mbap.encode(tid, 12, b"\x08\0\0\0\0") for tid in range(count)))
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
