"""The way in by TLS: who never finishes a handshake is one of few, ends soon, and keeps nobody out."""

from __future__ import annotations

import asyncio
import ssl
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest
from aiohttp import ClientSession, ClientTimeout

from gateway.faces.http.connection import Connection
from gateway.faces.http.handshakes import Handshakes
from gateway.service.loops import Loop, loop_factory
from tests.optional import optional

from .conftest import Gateway
from .test_access import certificate
from .test_listener import still_open, strangers

MakeGateway = Callable[..., Gateway]


@pytest.mark.parametrize("choice", [Loop.ASYNCIO, Loop.UVLOOP])
def test_strangers_who_never_shake_hands_are_few_and_keep_nobody_out(
    make_gateway: MakeGateway, tmp_path: Path, choice: Loop
) -> None:  # F67
    if choice is Loop.UVLOOP:
        optional("uvloop")
    with asyncio.Runner(loop_factory=loop_factory(choice)) as runner:
        runner.run(_besieged(make_gateway, tmp_path))


async def _besieged(make_gateway: MakeGateway, tmp_path: Path) -> None:
    crt, key = certificate(tmp_path)
    trusting = ssl.create_default_context(cafile=crt)
    trusting.check_hostname = False
    gateway = make_gateway(tls_certificate=crt, tls_private_key=key, max_connections=16)
    hello = bytes.fromhex("16 0301 0200 01 0001fc 0303")  # the beginning of a ClientHello of 512 bytes
    async with gateway.running(), strangers(gateway, 250) as silent, strangers(gateway, 250, hello) as begun:
        url = gateway.url.replace("http:", "https:")
        async with ClientSession(timeout=ClientTimeout(total=60)) as session:
            async with session.get(f"{url}/metrics", ssl=trusting) as reply:
                assert reply.status == 200
            kept = await asyncio.gather(*(still_open(streams) for streams in (*silent, *begun)))
            assert 0 < sum(kept) <= 16
            assert gateway.face.stats.closed_for_room >= 500 - 16
            async with session.get(f"{url}/healthz", ssl=trusting) as reply:
                assert reply.status == 200, "a connection that came in stays while others shake hands"


async def test_a_handshake_that_does_not_go_on_ends(make_gateway: MakeGateway, tmp_path: Path) -> None:  # F67
    crt, key = certificate(tmp_path)
    gateway = make_gateway(tls_certificate=crt, tls_private_key=key, idle_timeout_s=0.05)
    async with gateway.running():
        async with strangers(gateway, 1) as [(reader, _)], asyncio.timeout(30):
            await reader.read()
        async with strangers(gateway, 1, b"GET /metrics HTTP/1.1\r\n\r\n") as [(reader, _)], asyncio.timeout(30):
            await reader.read()  # that is no TLS


async def test_stopping_ends_handshakes(make_gateway: MakeGateway, tmp_path: Path) -> None:
    crt, key = certificate(tmp_path)
    gateway = make_gateway(tls_certificate=crt, tls_private_key=key, idle_timeout_s=60.0)
    async with gateway.running(), strangers(gateway, 3) as opened:
        async with asyncio.timeout(30):
            while gateway.face.stats.connections < 3:  # noqa: ASYNC110 - a counter sets no event
                await asyncio.sleep(0.001)
        for listener in gateway.face.listeners:
            await listener.stop()
        assert [await still_open(streams) for streams in opened] == [False] * 3
        assert gateway.face.listeners[0].bound is None


class EndedAtOnce(Connection):
    """Its handshake is done, and in this very turn of the loop it has to make room."""

    handshakes: Handshakes

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        self.handshakes._end(next(iter(self.handshakes._pending)))


@pytest.mark.parametrize("choice", [Loop.ASYNCIO, Loop.UVLOOP])
def test_one_that_makes_room_when_it_is_done_waits_for_nobody(
    make_gateway: MakeGateway, tmp_path: Path, choice: Loop
) -> None:
    if choice is Loop.UVLOOP:
        pytest.importorskip("uvloop")
    with asyncio.Runner(loop_factory=loop_factory(choice)) as runner:
        runner.run(_ended_when_done(make_gateway, tmp_path))


async def _ended_when_done(make_gateway: MakeGateway, tmp_path: Path) -> None:
    crt, key = certificate(tmp_path)
    gateway = make_gateway(tls_certificate=crt, tls_private_key=key, idle_timeout_s=3600.0, send_timeout_s=3600.0)
    async with gateway.running():
        [listener] = gateway.face.listeners
        handshakes, connections = listener._handshakes, listener._connections
        assert handshakes is not None
        assert connections is not None
        EndedAtOnce.handshakes = handshakes
        handshakes._protocol = lambda: EndedAtOnce(connections)
        async with strangers(gateway, 1) as [(reader, writer)], asyncio.timeout(20):
            received, to_send = ssl.MemoryBIO(), ssl.MemoryBIO()
            trusting = ssl.create_default_context()
            trusting.check_hostname, trusting.verify_mode = False, ssl.CERT_NONE
            tls = trusting.wrap_bio(received, to_send)
            while True:
                try:
                    tls.do_handshake()
                    break
                except ssl.SSLWantReadError:
                    writer.write(to_send.read())
                    received.write(await reader.read(65536))
            writer.write(to_send.read())
            with suppress(ConnectionError):
                await reader.read()  # and says nothing more
            while connections._live:  # noqa: ASYNC110 - a dictionary sets no event
                await asyncio.sleep(0)
