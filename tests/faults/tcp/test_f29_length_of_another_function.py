"""F29: a length that the function does not have: 03, and the next request is right."""

from __future__ import annotations

import pytest

from gateway.modbus import mbap
from tests.faces.modbus.conftest import GOOD, GOOD_REPLY, READ_1, Running


@pytest.mark.parametrize(
    "pdu",
    [
        *(b"\x03", b"\x03\0\0\0", READ_1 + b"\0", READ_1 * 50, b"\x01\0\0\0\0\0", b"\x02", b"\x04\0\0\0"),
        *(b"\x2b\x0e", b"\x2b\x0e\x01", b"\x2b\x0e\x01\0\0"),
    ],
)
async def test_a_pdu_of_the_wrong_length_is_03_and_the_next_request_is_right(running: Running, pdu: bytes) -> None:
    client = await running.connect()
    client.send(mbap.encode(5, 12, pdu) + GOOD)
    assert await client.adus(2) == [mbap.Adu(5, 12, bytes((pdu[0] | 0x80, 3))), mbap.Adu(1, 12, GOOD_REPLY[7:])]
