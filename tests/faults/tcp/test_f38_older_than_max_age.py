"""F38: what is older than max_age_s: one serial read or 0B, never old data."""

from __future__ import annotations

from gateway.errors import ReplyTimeout
from tests.faces.modbus.conftest import READ_80, Running


async def test_older_than_max_age_is_read_anew(running: Running) -> None:
    world = running.world
    world.poll(11)
    client = await running.connect()
    world.clock.now += 4.999
    await client.query(11, READ_80)
    assert not world.line(11).transactions
    world.clock.now += 0.001
    world.line(11).outcomes[1] = ReplyTimeout()
    assert await client.query(11, READ_80) == b"\x83\x0b", "never by old data"
    assert world.line(11).transactions == [(1, READ_80)]
