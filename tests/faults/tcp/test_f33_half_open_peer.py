"""F33: the cable is cut, the client has rebooted: its place is free within 60 s."""

from __future__ import annotations

import asyncio
import socket
import sys
from ipaddress import ip_network

import pytest

from gateway.faces.modbus import tcp
from tests.cable import Cable
from tests.faces.modbus.conftest import GOOD, READ_80, Running, Serve, World

CLIENT = """
import socket, sys
client = socket.create_connection((sys.argv[1], int(sys.argv[2])), 10)
client.sendall(bytes.fromhex(sys.argv[3]))
client.recv(1)
print("asked", flush=True)
sys.stdin.read()
"""


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
    assert (idle, interval, probes) == (30, 10, 3)
    assert sock.getsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT) == 20_000


@pytest.fixture(
    params=[
        pytest.param(30, id="in-seconds"),
        pytest.param(60, id="as-configured", marks=[pytest.mark.long, pytest.mark.timeout(120)]),
    ],
)
def within_s(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> int:
    """By when the place must be free; in the ordinary tier the kernel is given less time."""
    seconds: int = request.param
    if seconds < 60:
        monkeypatch.setattr(tcp, "KEEPALIVE_IDLE_S", 1)
        monkeypatch.setattr(tcp, "KEEPALIVE_INTERVAL_S", 1)
        monkeypatch.setattr(tcp, "USER_TIMEOUT_MS", 2_000)
    return seconds


@pytest.mark.parametrize("unacknowledged", [False, True], ids=["idle", "reply-on-its-way"])
@pytest.mark.peer
async def test_its_place_is_free_again(
    serve: Serve, world: World, cable: Cable, within_s: int, unacknowledged: bool
) -> None:
    running = await serve(listen=((cable.here, 0),), allow=(ip_network(f"{cable.there}/32"),))
    world.poll(12)
    line = world.line(11)
    line.held = True
    command = ("ip", "netns", "exec", cable.name, sys.executable, "-c", CLIENT, cable.here, str(running.address[1]))
    waits = GOOD[:6] + bytes((11,)) + READ_80 if unacknowledged else b""
    client = await asyncio.create_subprocess_exec(
        *command, (GOOD + waits).hex(), stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE
    )
    assert client.stdout is not None
    try:
        async with asyncio.timeout(30):
            assert await client.stdout.readline() == b"asked\n"
        assert len(line.waiting) == unacknowledged
        cable.cut()
        line.release()  # with a question under way its reply goes out, and nobody says that it has come
        async with asyncio.timeout(within_s):
            while world.stats.open_connections:  # noqa: ASYNC110 - the kernel ends it
                await asyncio.sleep(0.05)
    finally:
        client.kill()
        await client.wait()
