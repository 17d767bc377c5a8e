"""F35: one client floods: 06 beyond its bucket, then it is not read from; others and the polls are not affected."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from ipaddress import ip_network

import pytest

from gateway.core.ratelimit import PAUSE_LEAST_S, ClientRate, LineRates
from gateway.faces.modbus.connection import TURN
from gateway.faces.modbus.settings import RateSettings
from gateway.modbus import mbap
from tests.faces.modbus.conftest import READ_1, Running, Serve, World, read, registers

BUSY = b"\x83\x06"
RATES = RateSettings(ClientRate(requests_per_s=100.0, line_per_s=10.0), LineRates(30.0, 40.0), burst_s=1.0, networks=())


@pytest.fixture
async def limited(serve: Serve, world: World) -> Running:
    for unit in (11, 12, 21):
        world.poll(unit)
    return await serve(rate=RATES)


def ready(world: World, count: int) -> bytes:
    return b"".join(mbap.encode(tid, 12, READ_1) for tid in range(count))


async def test_beyond_its_bucket_a_client_is_told_06_once_and_then_not_read_from(limited: Running) -> None:
    world = limited.world
    flood = await limited.connect()
    flood.send(ready(world, 150))
    replies = await flood.adus(101)
    assert [reply.pdu for reply in replies] == [b"\x03\x02" + registers(2, 0, 1)] * 100 + [BUSY]
    assert [reply.tid for reply in replies] == list(range(101))
    connection = next(iter(limited.server._connections))
    assert connection._transport is not None
    assert not connection._transport.is_reading()
    assert (world.stats.requests, world.stats.cache_hits, world.stats.limited["client"]) == (101, 100, 1)
    world.clock.now += 1.0  # its bucket is full again
    rest = await flood.adus(49)
    assert [reply.tid for reply in rest] == list(range(101, 150))
    assert BUSY not in {reply.pdu for reply in rest}


async def test_another_client_keeps_all_its_requests(limited: Running) -> None:
    world = limited.world
    flood = await limited.connect(local_addr=("127.0.0.9", 0))
    other = await limited.connect(local_addr=("127.0.0.2", 0))
    flood.send(ready(world, 5000))
    for tid in range(90):
        assert await other.query(12, READ_1, tid) == b"\x03\x02" + registers(2, 0, 1)
    assert world.stats.limited["client"] < 10, "a flood is paused, not refused one by one"


async def test_ten_thousand_requests_a_second_keep_nobody_waiting_longer_than_a_turn(
    serve: Serve, world: World
) -> None:
    """As the gateway is by default. Counted in requests that are looked at, which a busy machine does not change."""
    rates = RateSettings(networks=())
    running = await serve(rate=rates)
    flood = await running.connect(local_addr=("127.0.0.9", 0))
    other = await running.connect(local_addr=("127.0.0.2", 0))
    clients = {client.name: client for client in running.server.clients}
    flooding = clients["127.0.0.9"]
    answered_at: list[int] = []  # how much had been asked by the flood when the other was answered

    (served,) = (each for each in running.server._connections if each.peer == "127.0.0.2")
    write = served._write

    def noted(data: bytes) -> None:
        answered_at.append(flooding.requests)
        write(data)

    served._write = noted
    ahead = []
    for tick in range(300):  # three seconds
        if tick % 100 == 0:
            world.poll(12)
        flood.send(ready(world, 100 if tick > 1 else 4 * TURN))  # at first, and once all is known, more than a turn
        before = flooding.requests
        assert await other.query(12, READ_1, tick) == b"\x03\x02" + registers(2, 0, 1)
        ahead.append(answered_at.pop() - before)
        if tick == 0:
            await flood.adus(4 * TURN)
        world.clock.now += 0.01
    assert ahead[0] > TURN / 2 < ahead[1], "as much as may be, before and after all is known"
    assert max(ahead) <= TURN, "one turn of the loop"
    bucket = rates.client.requests_per_s * rates.burst_s
    assert bucket <= flooding.requests <= bucket + 3 * rates.client.requests_per_s + flooding.limited
    assert 1 <= flooding.limited <= 3 / PAUSE_LEAST_S, "it is paused, not refused one by one"
    assert ahead[-50:] == [0] * 50, "nothing is read from it at the end"
    assert clients["127.0.0.2"].limited == 0
    flood.reset()


async def test_more_connections_give_no_more_tokens(limited: Running) -> None:
    clients = [await limited.connect() for _ in range(5)]
    refused = 0
    for client in clients:
        client.send(ready(limited.world, 50))
    for _ in range(2):
        for client in clients[:2]:
            refused += sum(reply.pdu == BUSY for reply in await client.adus(25))
    assert refused == 0
    for client in clients[2:]:
        refused += (await client.adu()).pdu == BUSY
    assert refused == 3


async def test_what_needs_a_line_has_its_own_and_smaller_bucket(limited: Running) -> None:
    world = limited.world
    client = await limited.connect()
    serial = [read(11, first, 1)[0][:1] + b"\xe0" + bytes((first, 0, 1)) for first in range(11)]
    client.send(b"".join(mbap.encode(tid, 11, pdu) for tid, pdu in enumerate(serial)))
    replies = await client.adus(11)
    assert [reply.pdu == BUSY for reply in replies] == [False] * 10 + [True]
    assert len(world.line(11).transactions) == 10
    assert world.stats.limited == {"client_line": 1}
    world.clock.now += 1.0
    world.poll(12)
    assert (await client.query(12, READ_1))[0] == 3


async def test_all_clients_together_do_not_ask_too_much_of_a_device_or_line(limited: Running) -> None:
    world = limited.world
    clients = [await limited.connect(local_addr=(f"127.0.0.{10 + number}", 0)) for number in range(5)]
    outcomes = []
    for at, unit in ((0, 11), (1, 11), (2, 11), (3, 12), (4, 11)):
        for first in range(10):
            reply = await clients[at].query(unit, b"\x03\xe0" + bytes((10 * at % 50 + first, 0, 1)))
            outcomes.append(reply == BUSY)
    assert outcomes == [False] * 40 + [True] * 10
    assert world.stats.limited == {"device": 10}
    assert await clients[4].query(21, b"\x03\xe0\x00\x00\x01") != BUSY, "the other line is free"
    for connection in limited.server._connections:
        assert connection._transport is not None
        assert connection._transport.is_reading(), "it is not this client's fault"


async def test_a_client_that_is_gone_has_no_new_bucket_when_it_comes_back(limited: Running) -> None:
    for attempt in range(3):
        client = await limited.connect()
        client.send(ready(limited.world, 101))
        replies = [reply.pdu for reply in await client.adus(101 if attempt == 0 else 1)]
        assert replies[-1] == BUSY
        await client.close()
        await limited.until(lambda: limited.world.stats.open_connections == 0)


async def test_what_a_network_is_allowed_is_configured(serve: Serve, world: World) -> None:
    world.poll(12)
    fast = ((ip_network("127.0.0.3/32"),), ClientRate(0.0, 10.0))
    running = await serve(rate=replace(RATES, networks=(fast,)))
    free = await running.connect(local_addr=("127.0.0.3", 0))
    free.send(ready(world, 3000))
    assert BUSY not in {reply.pdu for reply in await free.adus(3000)}


async def test_a_pause_ends_by_itself_and_with_its_connection(limited: Running) -> None:
    client, gone = await limited.connect(), await limited.connect()
    client.send(ready(limited.world, 101))
    await client.adus(101)
    gone.send(ready(limited.world, 3))
    await gone.adu()
    gone.reset()
    await limited.until(lambda: limited.world.stats.open_connections == 1)
    limited.world.clock.now += 10.0
    async with asyncio.timeout(30):
        assert (await client.query(12, READ_1))[0] == 3
