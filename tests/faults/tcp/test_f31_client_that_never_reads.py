"""F31: a client that never reads: paused at 16 replies or 8 KiB, cut off after 10 s, memory bounded."""

from __future__ import annotations

import asyncio
import socket
from dataclasses import replace

import pytest

from gateway.core.snapshot import Block
from gateway.devices.model import Space
from gateway.faces.modbus.connection import MAX_UNSENT, MAX_WAITING, Connection
from gateway.modbus import mbap
from tests.faces.modbus.conftest import Client, Running, Serve, World, read, registers

LONGEST = bytes.fromhex("03 0000 007d")
"""A read whose reply is as long as one can be: 125 registers."""


def remember_the_longest(world: World) -> None:
    device, now = world.device(12), world.clock.now
    world.poll(12)
    block = Block(Space.REGISTERS, 0, 125, registers(2, 0, 125), now)
    device.snapshot = replace(device.snapshot, version=device.snapshot.version + 1, blocks=(block,))


async def deaf(running: Running) -> tuple[Client, Connection]:
    """A client that reads nothing, and its connection.

    Over a pair of sockets: how much TCP holds, up to tens of megabytes, and when it sends again is the kernel's affair.
    """
    near, far = socket.socketpair()
    near.settimeout(0.0)
    near.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 32768)
    client = Client(*await asyncio.open_unix_connection(sock=far))
    running.clients.append(client)
    client.writer.transport.pause_reading()  # type: ignore[attr-defined]  # streams say WriteTransport
    running.server.listeners[0]._accepted(near, ("127.0.0.1", 1))
    (connection,) = running.server._connections
    return client, connection


@pytest.mark.parametrize("at_once", [1, 7, 16, 1000])
async def test_it_is_paused_then_cut_off(running: Running, at_once: int) -> None:
    world = running.world
    remember_the_longest(world)
    client, connection = await deaf(running)
    burst = mbap.encode(1, 12, LONGEST) * at_once
    async with asyncio.timeout(30):
        while connection._unsent_since is None:
            client.send(burst)
            await asyncio.sleep(0)
    asked = world.stats.requests
    assert connection._transport is not None
    assert 0 < connection._transport.get_write_buffer_size() <= MAX_UNSENT
    client.send(burst)
    await asyncio.sleep(0.01)
    assert world.stats.requests == asked, "nothing more is looked at"
    world.clock.now += 10.1
    running.server.sweep()
    await running.until(lambda: world.stats.open_connections == 0)
    assert world.stats.closed == {"not_reading": 1}


async def test_a_listener_that_stops_does_not_wait_for_it_for_ever(serve: Serve, world: World) -> None:
    running = await serve(stop_grace_s=0.05)
    remember_the_longest(world)
    client, connection = await deaf(running)
    async with asyncio.timeout(30):
        while connection._unsent_since is None:
            client.send(mbap.encode(1, 12, LONGEST) * 100)
            await asyncio.sleep(0)
        await running.server.listeners[0].stop()
    await running.until(lambda: world.stats.open_connections == 0)
    assert world.stats.closed == {"stopped": 1}


async def test_who_takes_its_replies_late_gets_them_all(running: Running) -> None:
    running.world.poll(12)
    client, connection = await deaf(running)
    count = 0
    async with asyncio.timeout(30):
        while connection._unsent_since is None:
            client.send(mbap.encode(1, 12, bytes.fromhex("03 0000 0050")) * 1000)
            count += 1000
            await asyncio.sleep(0.001)
    client.writer.transport.resume_reading()  # type: ignore[attr-defined]
    reply = mbap.encode(1, 12, b"\x03\xa0" + registers(2, 0, 80))
    async with asyncio.timeout(30):
        assert await client.reader.readexactly(count * len(reply)) == reply * count
    assert running.world.stats.cache_hits == count


async def test_replies_that_come_to_be_known_meanwhile_wait_in_their_places(running: Running) -> None:
    world = running.world
    remember_the_longest(world)
    line = world.line(11)
    line.held = True
    client, connection = await deaf(running)
    asked: list[tuple[int, bytes]] = []

    def ask(unit: int, pdu: bytes, reply: bytes) -> None:
        client.ask(len(asked), unit, pdu)
        asked.append((unit, reply))

    longest = b"\x03\xfa" + registers(2, 0, 125)
    async with asyncio.timeout(30):
        while connection._unsent_since is None:
            for _ in range(20):
                ask(12, LONGEST, longest)
            for at in range(MAX_WAITING):
                ask(11, *read(11, at, 80 - at))
            await running.until(lambda: bool(line.waiting) or connection._unsent_since is not None)
            for _ in range(MAX_WAITING):  # one by one, so that one of them finds the kernel full
                if line.waiting:
                    line.release(1)
            assert connection._transport is not None
            assert connection._transport.get_write_buffer_size() <= MAX_UNSENT
    line.held = False
    line.release()
    client.writer.transport.resume_reading()  # type: ignore[attr-defined]
    async with asyncio.timeout(30):
        replies = await client.adus(len(asked))
    assert replies == [mbap.Adu(tid & 0xFFFF, unit, reply) for tid, (unit, reply) in enumerate(asked)]


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
