"""Addresses, strangers, and stopping."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager

import pytest
from aiohttp import ClientSession, ClientTimeout

from gateway.errors import ListenError

from .conftest import Gateway

MakeGateway = Callable[..., Gateway]
Streams = tuple[asyncio.StreamReader, asyncio.StreamWriter]


@asynccontextmanager
async def strangers(gateway: Gateway, count: int, sends: bytes = b"") -> AsyncIterator[list[Streams]]:
    """Connections that send something, or nothing, and wait."""
    bound = gateway.face.listeners[0].bound
    assert bound is not None
    opened: list[Streams] = []
    try:
        for _ in range(count):
            reader, writer = await asyncio.open_connection(*bound)
            opened.append((reader, writer))
            writer.write(sends)
        yield opened
    finally:
        for _, writer in opened:
            writer.close()


async def still_open(streams: Streams) -> bool:
    """Whether the server keeps this silent connection; ends within a turn of the loop when it does not."""
    reader, _ = streams
    try:
        await asyncio.wait_for(reader.read(1), 0.02)
    except TimeoutError:
        return True
    except ConnectionError:
        pass
    return False


async def test_a_taken_port_is_named_and_can_be_tried_again(make_gateway: MakeGateway) -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        [listener] = make_gateway(listen=(("127.0.0.1", port),)).face.listeners
        with pytest.raises(ListenError, match=f"^http 127.0.0.1:{port}: another program listens there$"):
            await listener.start()
    await listener.start()
    assert listener.bound == ("127.0.0.1", port)
    await listener.stop()
    assert listener.bound is None


async def test_an_address_of_nobody_here_is_named(make_gateway: MakeGateway) -> None:
    [listener] = make_gateway(listen=(("192.0.2.1", 9850),)).face.listeners
    with pytest.raises(ListenError, match=r"^http 192\.0\.2\.1:9850: this machine has no such address$"):
        await listener.start()


async def test_two_addresses_are_two_listeners(make_gateway: MakeGateway) -> None:
    gateway = make_gateway(listen=(("127.0.0.1", 0), ("127.0.0.2", 0)))
    async with gateway.running(), ClientSession() as session:
        for listener in gateway.face.listeners:
            assert listener.bound is not None
            host, port = listener.bound
            async with session.get(f"http://{host}:{port}/healthz") as reply:
                assert reply.status == 200


async def test_it_starts_again_after_a_stop(make_gateway: MakeGateway) -> None:
    gateway = make_gateway()
    for _ in range(2):
        async with gateway.running(), ClientSession() as session, session.get(f"{gateway.url}/healthz") as reply:
            assert reply.status == 200


def test_labels_name_the_address(make_gateway: MakeGateway) -> None:
    face = make_gateway(listen=(("127.0.0.1", 9850), ("::1", 9850))).face
    assert [listener.label for listener in face.listeners] == ["http 127.0.0.1:9850", "http [::1]:9850"]


@pytest.mark.parametrize("sends", [b"", b"GET /metrics HTTP/1.1\r\nHost: "], ids=["idle", "half-sent"])
async def test_strangers_cannot_keep_a_scraper_out(make_gateway: MakeGateway, sends: bytes) -> None:  # F67
    gateway = make_gateway(max_connections=16)
    async with gateway.running(), strangers(gateway, 500, sends) as opened:
        async with (
            ClientSession(timeout=ClientTimeout(total=60)) as session,
            session.get(f"{gateway.url}/metrics") as reply,
        ):
            assert reply.status == 200
        kept = await asyncio.gather(*(still_open(streams) for streams in opened))
        assert 0 < sum(kept) <= 16
        assert gateway.face.stats.closed_for_room == 500 + 1 - 16  # each is counted once


@pytest.mark.parametrize("sends", [b"", b"GET /metrics HTTP/1.1\r\nHost: "], ids=["idle", "half-sent"])
async def test_a_header_that_does_not_come_ends_the_connection(make_gateway: MakeGateway, sends: bytes) -> None:  # F67
    gateway = make_gateway(idle_timeout_s=0.05)
    async with gateway.running(), strangers(gateway, 1, sends) as [(reader, _)]:
        async with asyncio.timeout(30):
            await reader.read()


async def test_a_connection_is_used_for_many_scrapes(gateway: Gateway) -> None:
    async with ClientSession() as session:
        for _ in range(3):
            async with session.get(f"{gateway.url}/metrics") as reply:
                await reply.read()
    assert gateway.face.stats.connections == 1
    assert gateway.face.stats.scrapes == 3


@pytest.mark.parametrize(
    "garbage", [b"\x16\x03\x01\x02\x00\x01\x00", b"GET\r\n\r\n", b"\x00" * 9000, b"A: b\r\n" * 5000]
)
async def test_garbage_is_refused_and_hurts_nobody(gateway: Gateway, garbage: bytes) -> None:
    async with strangers(gateway, 1, garbage) as [(reader, writer)]:
        writer.write_eof()
        async with asyncio.timeout(30):
            answer = await reader.read()
    assert not answer or answer.startswith((b"HTTP/1.1 400", b"HTTP/1.0 400"))
    async with ClientSession() as session, session.get(f"{gateway.url}/healthz") as reply:
        assert reply.status == 200


async def test_stop_does_not_wait_for_idle_connections(make_gateway: MakeGateway) -> None:
    gateway = make_gateway(idle_timeout_s=3600.0)
    async with gateway.running(), strangers(gateway, 3, b"GET / HTTP/1.1\r\n") as opened:
        async with asyncio.timeout(30):
            await gateway.face.listeners[0].stop()
        assert not any(await asyncio.gather(*(still_open(streams) for streams in opened)))
