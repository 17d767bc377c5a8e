"""F30: a request that comes byte by byte, one a second: whole within 5 s, or closed; others are not affected."""

from __future__ import annotations

from gateway.faces.modbus.connection import MAX_WAITING
from gateway.modbus import mbap
from tests.faces.modbus.conftest import GOOD, GOOD_REPLY, READ_1, Running


async def test_half_a_request_must_be_completed_in_time(running: Running) -> None:
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


async def test_half_a_request_that_became_whole_in_time_is_not_held_against_it(running: Running) -> None:
    world = running.world
    world.poll(12)
    client, other = await running.connect(), await running.connect()
    for _ in range(3):
        client.send(GOOD[:-1])
        await other.query(12, READ_1)
        world.clock.now += 4.0
        world.poll(12)
        running.server.sweep()
        client.send(GOOD[-1:])
        assert await client.adus(1) == [mbap.Adu(1, 12, GOOD_REPLY[7:])]
        world.clock.now += 4.0
        world.poll(12)
        running.server.sweep()
    assert world.stats.open_connections == 2
    assert not world.stats.closed


async def test_a_request_that_the_server_itself_left_half_read_is_not_late(running: Running) -> None:
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


async def test_a_byte_a_second_is_too_slow(running: Running) -> None:
    world = running.world
    world.poll(12)
    slow, other = await running.connect(), await running.connect()
    for sent in range(len(GOOD)):
        slow.send(GOOD[sent : sent + 1])
        await other.query(12, READ_1)
        world.clock.now += 1.0
        world.poll(12)
        running.server.sweep()
        if world.stats.closed:
            break
    assert sent == 5, "its first byte was taken six seconds ago"
    assert await slow.rest() == b""
    assert world.stats.closed == {"slow_frame": 1}
