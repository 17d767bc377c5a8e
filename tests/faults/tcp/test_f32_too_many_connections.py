"""F32: more connections than allowed: an idle one makes room, priority clients get in, descriptors never run out."""

from __future__ import annotations

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
