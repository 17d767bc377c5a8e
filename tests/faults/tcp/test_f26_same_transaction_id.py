"""F26: the same transaction id twice in flight: both answered, contexts kept apart."""

from __future__ import annotations

from gateway.modbus import mbap
from tests.faces.modbus.conftest import Running, read


async def test_both_are_answered_each_with_its_own(running: Running) -> None:
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
