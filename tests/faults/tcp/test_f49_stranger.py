"""F49: a source address that is not in the list: closed before a byte is read.

That the page is for reading only: tests/faces/http/test_app.py; that nothing listens off loopback unless it is
configured: tests/service/test_config.py.
"""

from __future__ import annotations

import asyncio
import socket
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


@pytest.mark.parametrize("peer", ["192.0.2.9", "2001:db8::9", "127.0.0.1"])
async def test_not_a_byte_of_it_is_read(serve: Serve, peer: str) -> None:
    """A socket that is closed with something unread in it is reset, which its other end sees."""
    running = await serve(allow=(ip_network("127.0.0.1/32"),))
    near, far = socket.socketpair()
    with far:
        near.settimeout(0.0)
        far.settimeout(10.0)
        far.sendall(GOOD)
        running.server.listeners[0]._accepted(near, (peer, 1))
        if peer == "127.0.0.1":  # whose bytes are read
            await running.until(lambda: running.world.stats.requests == 1)
            assert await asyncio.to_thread(far.recv, 300) == GOOD_REPLY
            return
        await running.until(lambda: running.world.stats.refused_connections == 1)
        with pytest.raises(ConnectionResetError):
            await asyncio.to_thread(far.recv, 1)
