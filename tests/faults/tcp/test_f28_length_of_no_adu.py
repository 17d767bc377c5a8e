"""F28: MBAP length 0, 1, 255, 65535: closed after what came before is answered, nothing executed, little buffered."""

from __future__ import annotations

import asyncio
import struct

import pytest

from gateway.modbus import mbap
from tests.faces.modbus.conftest import GOOD, GOOD_REPLY, READ_1, Running

LONGEST_ADU = 260


@pytest.mark.parametrize("length", [0, 1, 255, 256, 65535])
async def test_a_wrong_length_ends_the_connection_after_what_came_before(running: Running, length: int) -> None:
    line = running.world.line(12)
    line.held = True
    client = await running.connect()
    client.send(GOOD + struct.pack(">HHHB", 2, 0, length, 11) + READ_1 + GOOD)
    await running.until(lambda: len(line.waiting) == 1)
    line.release()
    assert await client.rest() == GOOD_REPLY
    assert line.transactions == [(2, READ_1)], "nothing after the loss is executed"
    assert running.world.stats.malformed == {"framing_length": 1}


@pytest.mark.parametrize("length", [0, 1, 255, 65535])
async def test_nothing_is_kept_of_what_follows_it(running: Running, length: int) -> None:
    line = running.world.line(12)
    line.held = True
    client = await running.connect()
    client.send(GOOD + struct.pack(">HHHB", 2, 0, length, 11) + GOOD * 200)
    await running.until(lambda: len(line.waiting) == 1)
    (connection,) = running.server._connections
    client.send(GOOD * 10_000)
    await asyncio.sleep(0.01)
    assert connection._transport is not None
    assert not connection._transport.is_reading()
    assert connection._splitter.pending + len(connection._input) <= LONGEST_ADU
    assert not connection._adus
    line.release()
    await running.until(lambda: running.world.stats.open_connections == 0)
    assert line.transactions == [(2, READ_1)]


async def test_no_more_than_one_adu_is_kept_of_one_that_does_not_end(running: Running) -> None:
    client = await running.connect()
    longest = mbap.encode(1, 12, bytes(253))
    assert len(longest) == LONGEST_ADU
    for at in range(len(longest) - 1):
        client.send(longest[at : at + 1])
        await asyncio.sleep(0)
    (connection,) = running.server._connections
    await running.until(lambda: connection._splitter.pending == LONGEST_ADU - 1)
    assert connection._input == b""
