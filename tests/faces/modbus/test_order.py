"""Many requests at once: each reply has its own transaction id, unit and value, in the order of the requests."""

from __future__ import annotations

from gateway.errors import ReplyTimeout
from gateway.modbus import mbap

from .conftest import Running, read


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
