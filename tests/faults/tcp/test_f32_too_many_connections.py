"""F32: more connections than allowed: an idle one makes room, priority clients get in, descriptors never run out."""

from __future__ import annotations

import asyncio
import os
import resource
from collections.abc import Iterator
from ipaddress import ip_network
from pathlib import Path

import pytest

from gateway.faces.modbus import accepting
from tests.faces.modbus.conftest import GOOD_REPLY, READ_1, Serve, World


async def test_the_longest_idle_connection_makes_room(serve: Serve, world: World) -> None:
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


async def test_connections_at_work_are_not_evicted(serve: Serve, world: World) -> None:
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


async def test_a_priority_client_always_gets_in(serve: Serve, world: World) -> None:
    running = await serve(max_connections=2, priority=(ip_network("127.0.0.9/32"),))
    world.poll(12)
    first, second = await running.connect(), await running.connect()
    await first.query(12, READ_1)
    world.clock.now += 1.0
    await second.query(12, READ_1)
    important = await running.connect(local_addr=("127.0.0.9", 0))
    assert await important.query(12, READ_1) == GOOD_REPLY[7:]
    assert await first.rest() == b""
    again = await running.connect(local_addr=("127.0.0.9", 0))
    assert await again.query(12, READ_1) == GOOD_REPLY[7:]
    assert await second.rest() == b""
    world.clock.now += 100.0
    world.poll(12)
    stranger = await running.connect()
    assert await stranger.rest() == b"", "none of them makes room for others"
    assert world.stats.closed == {"evicted": 2, "full": 1}


async def test_one_client_has_only_so_many(serve: Serve, world: World) -> None:
    running = await serve(max_per_client=2)
    world.poll(12)
    greedy = [await running.connect(local_addr=("127.0.0.5", 0)) for _ in range(3)]
    assert await greedy[2].rest() == b""
    assert await greedy[0].query(12, READ_1) == GOOD_REPLY[7:]
    other = await running.connect(local_addr=("127.0.0.6", 0))
    assert await other.query(12, READ_1) == GOOD_REPLY[7:]
    assert world.stats.closed == {"client_full": 1}


@pytest.fixture
def few_descriptors(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The process may have a few descriptors more than it has, over those that are spared."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    used = max(int(entry.name) for entry in Path("/proc/self/fd").iterdir())
    monkeypatch.setattr(accepting, "ACCEPT_PAUSE_S", 0.05)
    resource.setrlimit(resource.RLIMIT_NOFILE, (used + 12 + accepting.SPARE_DESCRIPTORS, hard))
    yield
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


@pytest.mark.usefixtures("few_descriptors")
async def test_descriptors_never_run_out(serve: Serve, world: World) -> None:
    """The clients of the test are in this process too, and take as many descriptors."""
    running = await serve()
    world.poll(12)
    acceptor = running.server.listeners[0]._acceptor
    assert acceptor is not None
    clients = []
    while not acceptor.pauses:
        clients.append(await running.connect())
        await asyncio.sleep(0.001)
        assert len(clients) < 200
    clients.append(await running.connect())  # waits in the kernel's queue until the pause is over
    await running.until(lambda: acceptor.pauses >= 2)
    assert await clients[0].query(12, READ_1) == GOOD_REPLY[7:]
    assert 0 < world.stats.open_connections < len(clients)
    for descriptor in [os.open("/dev/null", os.O_RDONLY) for _ in range(accepting.SPARE_DESCRIPTORS // 2)]:
        os.close(descriptor)  # the rest of the process has what it needs
    for client in clients:
        client.reset()
    await running.until(lambda: world.stats.open_connections == 0)
    late = await running.connect()
    assert await late.query(12, READ_1) == GOOD_REPLY[7:]
