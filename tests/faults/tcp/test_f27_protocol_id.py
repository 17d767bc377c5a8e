"""F27: a protocol id other than 0: discarded and counted; three in a row close the connection."""

from __future__ import annotations

from gateway.modbus import mbap
from tests.faces.modbus.conftest import GOOD, GOOD_REPLY, READ_1, Running


def foreign(protocol: int = 1) -> bytes:
    return b"\x00\x09" + protocol.to_bytes(2) + b"\x00\x06\x0c" + READ_1


async def test_it_is_skipped_and_counted(running: Running) -> None:
    client = await running.connect()
    for _ in range(3):  # never three in a row
        client.send(foreign() + foreign(0xFFFF) + GOOD)
        assert await client.adu() == mbap.Adu(1, 12, GOOD_REPLY[7:])
    assert running.world.stats.malformed == {"protocol_id": 6}


async def test_answers_between_do_not_add_up_to_three_in_a_row(running: Running) -> None:
    running.world.poll(12)
    client = await running.connect()
    for _ in range(5):
        client.send(foreign())
        for _ in range(3):  # the later ones are found ready
            assert await client.query(12, READ_1) == GOOD_REPLY[7:]
    assert running.world.stats.closed["framing_lost"] == 0


async def test_three_in_a_row_end_the_connection(running: Running) -> None:
    client = await running.connect()
    client.send(GOOD + foreign() * 3 + GOOD)
    assert await client.rest() == GOOD_REPLY
    assert running.world.stats.closed == {"framing_lost": 1}
