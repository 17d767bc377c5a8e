"""F28: MBAP length 0, 1, 255, 65535: closed after what came before is answered, nothing executed, little buffered."""

from __future__ import annotations

import struct

import pytest

from tests.faces.modbus.conftest import GOOD, GOOD_REPLY, READ_1, Running


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
