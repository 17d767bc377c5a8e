"""F31: a client that never reads: paused at 16 replies or 8 KiB, cut off after 10 s, memory bounded."""

from __future__ import annotations

import asyncio
import socket

from gateway.faces.modbus.connection import MAX_BURST, MAX_UNSENT, MAX_WAITING
from gateway.modbus import mbap
from tests.faces.modbus.conftest import Running, read, registers


async def test_it_is_paused_then_cut_off(running: Running) -> None:
    world = running.world
    world.poll(12)
    client = await running.connect()
    sock = client.writer.get_extra_info("socket")
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    client.reader._transport.pause_reading()  # type: ignore[attr-defined]
    burst = mbap.encode(1, 12, bytes.fromhex("03 0000 0050")) * 1000
    connection = next(iter(running.server._connections))
    async with asyncio.timeout(30):
        while connection._unsent_since is None:
            client.send(burst)
            await asyncio.sleep(0.001)
    asked = world.stats.requests
    assert connection._transport is not None
    assert connection._transport.get_write_buffer_size() <= MAX_UNSENT + MAX_BURST * 260, "and one burst over it"
    client.send(burst)
    await asyncio.sleep(0.01)
    assert world.stats.requests == asked, "nothing more is looked at"
    world.clock.now += 10.1
    running.server.sweep()
    await running.until(lambda: world.stats.open_connections == 0)
    assert world.stats.closed == {"not_reading": 1}


async def test_who_takes_its_replies_late_gets_them_all(running: Running) -> None:
    running.world.poll(12)
    client = await running.connect()
    client.reader._transport.pause_reading()  # type: ignore[attr-defined]
    connection = next(iter(running.server._connections))
    count = 0
    async with asyncio.timeout(30):
        while connection._unsent_since is None:
            client.send(mbap.encode(1, 12, bytes.fromhex("03 0000 0050")) * 1000)
            count += 1000
            await asyncio.sleep(0.001)
    client.reader._transport.resume_reading()  # type: ignore[attr-defined]
    reply = mbap.encode(1, 12, b"\x03\xa0" + registers(2, 0, 80))
    async with asyncio.timeout(30):
        assert await client.reader.readexactly(count * len(reply)) == reply * count
    assert running.world.stats.cache_hits == count


async def test_no_more_than_the_bound_waits_on_the_line(running: Running) -> None:
    line = running.world.line(11)
    line.held = True
    client = await running.connect()
    asked = [read(11, at, 1) for at in range(60)]
    client.send(b"".join(mbap.encode(tid, 11, request) for tid, (request, _) in enumerate(asked)))
    await running.until(lambda: len(line.waiting) == MAX_WAITING)
    client.ask(60, 11, read(11, 60, 1)[0])
    await asyncio.sleep(0.02)  # time in which a server that reads on would take more
    assert len(line.waiting) == MAX_WAITING
    line.held = False
    line.release()
    replies = await client.adus(61)
    assert [reply.tid for reply in replies] == list(range(61))
    assert [reply.pdu for reply in replies[:60]] == [reply for _, reply in asked]
