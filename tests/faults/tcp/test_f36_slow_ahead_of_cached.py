"""F36: a slow serial request ahead of cached ones: only its own connection waits."""

from __future__ import annotations

from gateway.modbus import mbap
from tests.faces.modbus.conftest import Running, read


async def test_a_slow_serial_request_delays_only_its_own_connection(running: Running) -> None:
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
    assert len(world.line(11).waiting) == 1  # the slow one still is
    world.line(11).release()
    assert await slow.adus(2) == [mbap.Adu(1, 11, asked_reply), mbap.Adu(2, 12, cached_reply)]
