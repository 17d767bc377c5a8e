"""Connections byte by byte: what comes back, in which order, and when they end."""

from __future__ import annotations

import asyncio
import logging
import socket
import struct
from asyncio.trsock import TransportSocket
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager

import pytest

from gateway.faces.http import connection as connection_module
from gateway.faces.http.connection import BUSY_FACTOR, Connection
from gateway.faces.http.listener import SEND_BUFFER
from gateway.faces.http.request import Reply, Request
from gateway.faces.http.wire import HEAD_BYTES, Head, Refusal, take
from gateway.service.loops import Loop, loop_factory

from .conftest import Gateway
from .test_listener import still_open, strangers

MakeGateway = Callable[..., Gateway]


def get(path: str, *fields: str, version: str = "1.1", method: str = "GET") -> bytes:
    return "\r\n".join((f"{method} {path} HTTP/{version}", "Host: gateway", *fields, "", "")).encode()


async def talk(gateway: Gateway, *sends: bytes, half_closed: bool = False) -> bytes:
    """Everything that comes back until the gateway closes."""
    bound = gateway.face.listeners[0].bound
    assert bound is not None
    reader, writer = await asyncio.open_connection(*bound)
    try:
        for data in sends:
            writer.write(data)
            await writer.drain()
        if half_closed:
            writer.write_eof()
        async with asyncio.timeout(10):
            return await reader.read()
    finally:
        writer.close()


async def test_a_reply_has_a_date_a_length_and_is_not_kept(gateway: Gateway) -> None:
    head, _, body = (await talk(gateway, get("/healthz", "Connection: close"))).partition(b"\r\n\r\n")
    lines = head.decode().split("\r\n")
    assert lines[0] == "HTTP/1.1 200 OK"
    assert set(lines[1:]) == {
        "Date: Tue, 14 Nov 2023 22:13:20 GMT",
        "Content-Type: text/plain; charset=utf-8",
        "Content-Length: 3",
        "Cache-Control: no-store",
        "Connection: close",
    }
    assert body == b"ok\n"


async def test_requests_in_one_go_are_answered_in_their_order(gateway: Gateway) -> None:
    paths = ["/healthz", "/nothing", "/metrics", "/readyz"] * 5
    data = b"".join(get(path) for path in paths) + get("/healthz", "Connection: close") + get("/readyz")
    replies = (await talk(gateway, data)).split(b"HTTP/1.1 ")[1:]
    assert [reply[:3] for reply in replies] == [b"200", b"404", b"200", b"200"] * 5 + [b"200"]
    assert all(b"morningstar_up" in reply for reply in replies[2::4])
    assert gateway.face.stats.connections == 1


async def test_more_requests_than_are_kept_wait_in_the_socket(gateway: Gateway) -> None:
    count = 4 * HEAD_BYTES // len(get("/healthz"))
    replies = await talk(gateway, get("/healthz") * count, get("/healthz", "Connection: close"))
    assert replies.count(b"200 OK") == count + 1


async def test_http_1_0_has_no_chunks_and_ends_by_closing(gateway: Gateway) -> None:
    reply = await talk(gateway, get("/metrics", version="1.0"))
    head, _, body = reply.partition(b"\r\n\r\n")
    assert b"chunked" not in head
    assert b"Connection: close" in head
    assert body.startswith(b"# HELP")
    assert body.endswith(b"\n")


@pytest.mark.parametrize("path", ["/metrics", "/api/v1/clients"])
async def test_who_has_said_all_still_gets_the_reply(gateway: Gateway, path: str) -> None:
    reply = await talk(gateway, get(path), half_closed=True)
    assert reply.startswith(b"HTTP/1.1 200")
    assert reply.endswith((b"0\r\n\r\n", b"}"))


@pytest.mark.parametrize("path", ["/metrics", "/", "/nothing"])
async def test_head_has_no_body_and_the_connection_goes_on(gateway: Gateway, path: str) -> None:
    reply = await talk(gateway, get(path, method="HEAD"), get("/healthz", "Connection: close"))
    first, _, second = reply.partition(b"\r\n\r\n")
    assert b"HTTP/1.1" in first
    assert second.startswith(b"HTTP/1.1 200 OK")


async def test_what_is_refused_behind_a_head_has_a_body(gateway: Gateway) -> None:
    reply = await talk(gateway, get("/healthz", method="HEAD") + b"no HTTP\r\n\r\n")
    refused = reply[reply.index(b"HTTP/1.1 400") :]
    assert b"Content-Length: 28\r\n" in refused
    assert refused.endswith(b"\r\n\r\nno request line of HTTP/1.1\n")


async def test_a_head_in_ever_so_many_pieces_is_read_a_few_times(
    gateway: Gateway, monkeypatch: pytest.MonkeyPatch
) -> None:
    looks = 0

    def counted(buffer: bytearray) -> Head | Refusal | None:
        nonlocal looks
        looks += 1
        return take(buffer)

    monkeypatch.setattr(connection_module, "take", counted)
    head = get("/healthz", f"Field: {'x' * HEAD_BYTES}")
    bound = gateway.face.listeners[0].bound
    assert bound is not None
    reader, writer = await asyncio.open_connection(*bound)
    writer.get_extra_info("socket").setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    for at in range(HEAD_BYTES):
        writer.write(head[at : at + 1])
        await asyncio.sleep(0)
    async with asyncio.timeout(10):
        reply = await reader.read()
    writer.close()
    assert reply.startswith(b"HTTP/1.1 431")
    assert looks <= 2 * HEAD_BYTES.bit_length()


@pytest.mark.parametrize(
    ("method", "field", "status"),
    [("POST", "Content-Length: 40", b"405"), ("GET", "Transfer-Encoding: chunked", b"413")],
)
async def test_a_body_is_never_taken_for_a_request(gateway: Gateway, method: str, field: str, status: bytes) -> None:
    smuggled = get("/metrics")
    reply = await talk(gateway, get("/metrics", field, method=method) + smuggled)
    assert reply.count(b"HTTP/1.1 ") == 1
    assert reply[9:12] == status
    assert gateway.face.stats.scrapes == 0


async def test_a_handler_that_fails_costs_its_own_connection(
    gateway: Gateway, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    async def broken(_request: Request) -> Reply:
        raise ZeroDivisionError

    monkeypatch.setitem(gateway.face._pages, "/broken", broken)
    with caplog.at_level(logging.ERROR):
        reply = await talk(gateway, get("/broken") + get("/healthz"))
    assert reply.startswith(b"HTTP/1.1 500 ")
    assert reply.count(b"HTTP/1.1") == 1
    assert b"ZeroDivision" not in reply
    assert 'event=http_request_failed path="/broken"' in caplog.text
    assert gateway.face.stats.failed == 1
    assert (await talk(gateway, get("/healthz", "Connection: close"))).endswith(b"ok\n")


@asynccontextmanager
async def waiting(gateway: Gateway, monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[asyncio.Event]:
    """A page that answers when it is let, and sees its own end."""
    gate = asyncio.Event()

    async def wait(_request: Request) -> Reply:
        await gate.wait()
        return Reply(200, b"done\n")

    monkeypatch.setitem(gateway.face._pages, "/wait", wait)
    yield gate
    gate.set()


async def test_a_request_under_way_makes_no_room_but_not_for_ever(
    make_gateway: MakeGateway, monkeypatch: pytest.MonkeyPatch
) -> None:
    most = 2
    async with (
        make_gateway(max_connections=most).running() as gateway,
        waiting(gateway, monkeypatch) as gate,
        strangers(gateway, BUSY_FACTOR * most + 3, get("/wait", "Connection: close")) as opened,
    ):
        async with asyncio.timeout(10):
            while gateway.face.stats.closed_for_room < 3:  # noqa: ASYNC110  a counter sets no event
                await asyncio.sleep(0.001)
        gate.set()
        replies = await asyncio.gather(*(reader.read() for reader, _ in opened), return_exceptions=True)
    good = [reply for reply in replies if isinstance(reply, bytes) and reply.endswith(b"done\n")]
    assert len(good) == BUSY_FACTOR * most


class Ending(asyncio.Transport):
    """A transport that was told to end, and has not told its protocol yet."""

    told = False

    def __init__(self, sock: socket.socket | None = None, left: int = 0) -> None:
        super().__init__({"socket": sock})
        self._left = left

    def get_write_buffer_size(self) -> int:
        return self._left

    def abort(self) -> None:
        self.told = True

    def is_closing(self) -> bool:
        return self.told


async def test_who_makes_room_is_counted_once_however_many_come_in_a_turn(gateway: Gateway) -> None:
    connections = gateway.face.listeners[0]._connections
    assert connections is not None
    most, more = connections.settings.max_connections, 5
    made = [connections() for _ in range(most + more)]
    for connection in made:
        connection.connection_made(Ending())
    assert gateway.face.stats.closed_for_room == more
    assert [each.aborted for each in made] == [True] * more + [False] * most
    for connection in made:
        connection.connection_lost(None)


async def test_where_all_are_busy_one_that_takes_no_reply_makes_room(
    make_gateway: MakeGateway, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Who asks for much and does not read it is busy for as long as he likes, and would keep everybody out."""
    async with make_gateway(max_connections=1).running() as gateway, waiting(gateway, monkeypatch):
        connections = gateway.face.listeners[0]._connections
        assert connections is not None

        def came() -> Connection:
            connection = connections()
            connection.connection_made(Ending())
            connection.data_received(get("/wait"))
            return connection

        made = [came() for _ in range(BUSY_FACTOR)]
        for connection in made[1:3]:
            connection.pause_writing()
        made[1].resume_writing()
        newcomers = [came(), came()]
        assert [each.aborted for each in (*made, *newcomers)] == [False, False, True, False, False, True]
        assert gateway.face.stats.closed_for_room == 2
        made[1].pause_writing()
        made[2].connection_lost(None)
        newcomers[1].connection_lost(None)
        assert not came().aborted
        assert made[1].aborted
        for connection in tuple(connections._live):
            connection.connection_lost(None)


@pytest.mark.parametrize("choice", [Loop.ASYNCIO, Loop.UVLOOP])
@pytest.mark.parametrize("version", ["1.0", "1.1"])
def test_a_reply_that_is_broken_off_is_not_taken_for_a_whole_one(
    make_gateway: MakeGateway, monkeypatch: pytest.MonkeyPatch, version: str, choice: Loop
) -> None:
    """A client of HTTP/1.0 knows nothing of chunks: to it an orderly end is the end of the reply."""
    if choice is Loop.UVLOOP:
        pytest.importorskip("uvloop")
    with asyncio.Runner(loop_factory=loop_factory(choice)) as runner:
        runner.run(_broken_off(make_gateway, monkeypatch, version))


async def _broken_off(make_gateway: MakeGateway, monkeypatch: pytest.MonkeyPatch, version: str) -> None:
    taken = asyncio.Event()

    async def part(request: Request) -> None:
        request.by.begin(())
        await request.by.write(b"the first half")
        await taken.wait()
        request.by.abort()

    async with make_gateway().running() as gateway:
        monkeypatch.setitem(gateway.face._pages, "/part", part)
        async with strangers(gateway, 1, get("/part", version=version)) as [(reader, _)], asyncio.timeout(10):
            await reader.readuntil(b"the first half")
            taken.set()
            with pytest.raises(ConnectionResetError):
                await reader.read()


@pytest.mark.parametrize("left", [0, 5])
async def test_so_is_one_of_which_the_end_was_not_sent_yet(gateway: Gateway, left: int) -> None:
    """Its request is over, for the last of the reply fits the buffer; whoever makes room for others loses that."""
    connections = gateway.face.listeners[0]._connections
    assert connections is not None
    with socket.socket() as sock:
        connection = connections()
        connection.connection_made(Ending(sock, left))
        connection.abort()
        resets = sock.getsockopt(socket.SOL_SOCKET, socket.SO_LINGER, 8) == struct.pack("ii", 1, 0)
    assert resets is bool(left)
    connection.connection_lost(None)


async def test_what_a_client_leaves_in_the_kernel_is_little(gateway: Gateway) -> None:
    connections = gateway.face.listeners[0]._connections
    assert connections is not None
    async with strangers(gateway, 1), asyncio.timeout(10):
        while not connections._live:  # noqa: ASYNC110  as above
            await asyncio.sleep(0.001)
        [connection] = connections._live
        sock = connection._extra("socket")
        assert isinstance(sock, TransportSocket)
        assert sock.getsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF) <= 2 * SEND_BUFFER


async def test_stopping_lets_a_reply_under_way_go_out(
    make_gateway: MakeGateway, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with make_gateway(stop_grace_s=60.0).running() as gateway, waiting(gateway, monkeypatch) as gate:
        asking = asyncio.create_task(talk(gateway, get("/wait")))
        connections = gateway.face.listeners[0]._connections
        assert connections is not None
        async with asyncio.timeout(10):
            while not any(each.busy for each in connections._live):  # noqa: ASYNC110  as above
                await asyncio.sleep(0.001)
        stopping = asyncio.create_task(gateway.face.listeners[0].stop())
        await asyncio.sleep(0)
        gate.set()
        await stopping
        assert (await asking).endswith(b"done\n")


async def test_a_client_that_breaks_off_ends_its_request(gateway: Gateway, monkeypatch: pytest.MonkeyPatch) -> None:
    ended = asyncio.Event()

    async def wait(_request: Request) -> Reply:
        try:
            await asyncio.Event().wait()
        finally:
            ended.set()
        raise AssertionError

    monkeypatch.setitem(gateway.face._pages, "/wait", wait)
    async with strangers(gateway, 1, get("/wait")) as [streams]:
        assert await still_open(streams)
        reset = struct.pack("ii", 1, 0)  # an end without a farewell; with one it may only have said all
        streams[1].get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, reset)
        streams[1].transport.abort()
        async with asyncio.timeout(10):
            await ended.wait()
    assert gateway.face.stats.failed == 0
