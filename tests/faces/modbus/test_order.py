"""Many requests at once: each reply has its own transaction id, unit and value, in the order of the requests."""

from __future__ import annotations

import asyncio
from random import Random

import pytest

from gateway.errors import ReplyTimeout
from gateway.faces.modbus.connection import MAX_WAITING
from gateway.modbus import mbap

from .conftest import Running, registers

ADDRESS = {11: 1, 12: 2, 21: 1}


def read(unit: int, first: int, count: int) -> tuple[bytes, bytes]:
    """A request PDU and the reply it must get."""
    data = registers(ADDRESS[unit], first, count)
    return b"\x03" + first.to_bytes(2) + count.to_bytes(2), bytes((3, len(data))) + data


async def test_f25_pipelined_to_three_units_cached_and_serial(running: Running) -> None:
    running.world.poll(12)  # 11 and 21 have to be asked
    client = await running.connect()
    asked = []
    for at in range(16):
        unit = (11, 12, 21)[at % 3]
        asked.append((1000 + at, unit, *read(unit, at, 1 + at)))
    client.send(b"".join(mbap.encode(tid, unit, request) for tid, unit, request, _ in asked))
    assert await client.adus(16) == [mbap.Adu(tid, unit, reply) for tid, unit, _, reply in asked]


@pytest.mark.parametrize("held", [False, True])
async def test_200_pipelined_requests_to_three_units(running: Running, held: bool) -> None:
    running.world.poll(12)
    for line in running.world.lines:
        line.held = held
    client = await running.connect()
    rng = Random(7)
    asked = []
    for tid in range(200):
        unit = rng.choice((11, 12, 12, 21))
        asked.append((tid, unit, *read(unit, rng.randrange(60), rng.randrange(1, 20))))
    client.send(b"".join(mbap.encode(tid, unit, request) for tid, unit, request, _ in asked))

    async def let_lines_answer() -> None:
        while True:
            await running.until(lambda: any(line.waiting for line in running.world.lines))
            for line in running.world.lines:
                assert len(line.waiting) <= MAX_WAITING
                line.release()

    async with asyncio.TaskGroup() as group:
        lines = group.create_task(let_lines_answer()) if held else None
        replies = await client.adus(200)
        if lines is not None:
            lines.cancel()
    assert replies == [mbap.Adu(tid, unit, reply) for tid, unit, _, reply in asked]
    assert running.world.stats.requests == 200
    assert running.world.stats.cache_hits + running.world.stats.forwarded == 200


async def test_f26_the_same_transaction_id_twice_in_flight(running: Running) -> None:
    line = running.world.line(11)
    line.held = True
    client = await running.connect()
    (first, first_reply), (second, second_reply) = read(11, 0, 2), read(12, 5, 1)
    client.ask(7, 11, first)
    client.ask(7, 12, second)
    await running.until(lambda: len(line.waiting) == 2)
    line.waiting.reverse()  # the second is answered first
    line.release()
    assert await client.adus(2) == [mbap.Adu(7, 11, first_reply), mbap.Adu(7, 12, second_reply)]


async def test_f36_a_slow_serial_request_delays_only_its_own_connection(running: Running) -> None:
    world = running.world
    world.poll(12)
    world.line(11).held = True
    slow, other = await running.connect(), await running.connect()
    cached, cached_reply = read(12, 0, 80)
    asked, asked_reply = read(11, 0, 1)
    slow.ask(1, 11, asked)
    slow.ask(2, 12, cached)
    await running.until(lambda: len(world.line(11).waiting) == 1)
    for tid in range(50):
        assert await other.query(12, cached, tid) == cached_reply
    world.line(11).release()
    assert await slow.adus(2) == [mbap.Adu(1, 11, asked_reply), mbap.Adu(2, 12, cached_reply)]


async def test_f37_many_clients_ask_the_same_and_the_line_once(running: Running) -> None:
    line = running.world.line(11)
    line.held = True
    clients = [await running.connect() for _ in range(8)]
    request, reply = read(11, 0xE000 & 0x3F, 10)
    for tid, client in enumerate(clients):
        client.ask(tid, 11, request)
    await running.until(lambda: bool(line.waiting) and len(line.waiting[0].waiters) == 8)
    clients[3].reset()
    await running.until(lambda: running.world.stats.open_connections == 7)
    line.release()
    for tid, client in enumerate(clients):
        if tid != 3:
            assert await client.adu() == mbap.Adu(tid, 11, reply)
    assert line.transactions == [(1, request)]


async def test_an_error_keeps_its_place_in_the_order(running: Running) -> None:
    world = running.world
    world.line(11).held = True
    world.line(11).outcomes[1] = ReplyTimeout()
    client = await running.connect()
    good, good_reply = read(12, 0, 1)
    client.ask(1, 11, good)
    client.ask(2, 99, good)
    client.ask(3, 12, good)
    await running.until(lambda: len(world.line(11).waiting) == 2)
    world.line(11).release()
    assert await client.adus(3) == [
        mbap.Adu(1, 11, b"\x83\x0b"),
        mbap.Adu(2, 99, b"\x83\x0a"),
        mbap.Adu(3, 12, good_reply),
    ]


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
