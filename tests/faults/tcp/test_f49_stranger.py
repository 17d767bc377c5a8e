"""F49: a source address that is not in the list: closed before a byte is read."""

from __future__ import annotations

from ipaddress import ip_network

import pytest

from tests.faces.modbus.conftest import GOOD, GOOD_REPLY, READ_1, Serve, World


async def test_an_address_that_is_not_allowed_is_cut_off_unread(
    serve: Serve, world: World, caplog: pytest.LogCaptureFixture
) -> None:
    running = await serve(allow=(ip_network("127.0.0.2/32"),))
    for _ in range(3):
        stranger = await running.connect()
        stranger.send(GOOD)
        assert await stranger.rest() == b""
    friend = await running.connect(local_addr=("127.0.0.2", 0))
    assert await friend.query(12, READ_1) == GOOD_REPLY[7:]
    assert world.stats.requests == 1
    assert world.stats.refused_connections == 3
    lines = [record for record in caplog.records if "connection_refused" in record.getMessage()]
    assert len(lines) == 1
