"""F33: the cable is cut, the client has rebooted: its place is free within 60 s."""

from __future__ import annotations

import socket

import pytest

from tests.faces.modbus.conftest import Running


@pytest.mark.skipif(not hasattr(socket, "TCP_USER_TIMEOUT"), reason="only Linux has it")
async def test_the_kernel_is_told_to_find_out_within_a_minute(running: Running) -> None:
    await running.connect()
    await running.until(lambda: running.world.stats.open_connections == 1)
    transport = next(iter(running.server._connections))._transport
    assert transport is not None
    sock = transport.get_extra_info("socket")
    assert sock.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE)
    assert sock.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
    idle, interval, probes = (
        sock.getsockopt(socket.IPPROTO_TCP, option)
        for option in (socket.TCP_KEEPIDLE, socket.TCP_KEEPINTVL, socket.TCP_KEEPCNT)
    )
    assert idle + interval * probes <= 60
    assert sock.getsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT) == 20_000
