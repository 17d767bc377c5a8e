"""F34: RST between request and reply, FIN with replies pending: no exception escapes, replies after FIN are sent."""

from __future__ import annotations

from gateway.modbus import mbap
from tests.faces.modbus.conftest import GOOD, GOOD_REPLY, READ_1, Running


async def test_half_closed_client_still_gets_its_replies(running: Running) -> None:
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


async def test_reset_with_requests_under_way(running: Running) -> None:
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
    assert (world.stats.requests, world.stats.forwarded, world.stats.connections) == (3, 3, 2)
    assert world.stats.open_connections == 1
    assert not world.stats.closed, "nobody had to end it"
