"""The face's own transport keeps asyncio's promises to its protocol."""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
import struct
from collections.abc import Callable, Iterator

import pytest

from gateway.faces.binding import listening_socket
from gateway.faces.modbus.accepting import ACCEPT_PAUSE_S, Acceptor
from gateway.faces.modbus.sockets import FIRST_BYTES, READ_BYTES, TURN, Hub, SocketTransport


class Recorder(asyncio.Protocol):
    """Writes down what it is told."""

    def __init__(self) -> None:
        self.told: list[str] = []
        self.received = bytearray()
        self.transport: SocketTransport | None = None
        self.lost = asyncio.Event()
        self.stay_open = False
        self.answer: Callable[[bytes], None] | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, SocketTransport)
        self.transport = transport
        self.told.append("made")

    def data_received(self, data: bytes) -> None:
        assert not self.lost.is_set()
        self.received += data
        self.told.append("data")
        if self.answer is not None:
            self.answer(data)

    def eof_received(self) -> bool:
        self.told.append("eof")
        return self.stay_open

    def pause_writing(self) -> None:
        self.told.append("pause")

    def resume_writing(self) -> None:
        self.told.append("resume")

    def connection_lost(self, exc: Exception | None) -> None:
        self.told.append("lost")
        self.lost.set()


Pair = tuple[Recorder, SocketTransport, socket.socket]


@pytest.fixture
async def hub() -> Hub:
    return Hub()


@pytest.fixture
def opened() -> Iterator[list[socket.socket]]:
    sockets: list[socket.socket] = []
    yield sockets
    for sock in sockets:
        sock.close()


@pytest.fixture
async def pair(hub: Hub, opened: list[socket.socket]) -> Pair:
    """A protocol on one end of a TCP connection; the other end blocks for 10 s at most."""
    return connected(hub, opened)


def connected(hub: Hub, opened: list[socket.socket]) -> Pair:
    with socket.create_server(("127.0.0.1", 0)) as server:
        far = socket.create_connection(server.getsockname(), 10)
        near, peername = server.accept()
    opened += [far]
    near.settimeout(0.0)
    recorder = Recorder()
    transport = SocketTransport(hub, near, peername, recorder)
    return recorder, transport, far


async def until(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(30):
        while not condition():  # noqa: ASYNC110 - the condition is the kernel's, which sets no event
            await asyncio.sleep(0.001)


def read_to_the_end(sock: socket.socket) -> None:
    while sock.recv(1 << 20):
        pass


def reset(sock: socket.socket) -> None:
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    sock.close()


async def test_bytes_come_in_pieces_and_in_order(pair: Pair) -> None:
    recorder, transport, far = pair
    data = os.urandom(5 * READ_BYTES + 7)
    far.sendall(data)
    await until(lambda: len(recorder.received) == len(data))
    assert bytes(recorder.received) == data
    transport.abort()
    await recorder.lost.wait()
    assert [told for told in recorder.told if told != "data"] == ["made", "lost"]


@pytest.mark.parametrize("size", [1, FIRST_BYTES, FIRST_BYTES + 1, FIRST_BYTES + READ_BYTES, 3 * READ_BYTES])
async def test_bytes_and_the_end_that_come_at_once_are_both_told(pair: Pair, size: int) -> None:
    recorder, _, far = pair
    far.sendall(bytes(size))
    far.shutdown(socket.SHUT_WR)
    await until(recorder.lost.is_set)
    assert len(recorder.received) == size
    assert [told for told in recorder.told if told != "data"] == ["made", "eof", "lost"]


@pytest.mark.parametrize("size", [FIRST_BYTES, FIRST_BYTES + READ_BYTES, 7 * READ_BYTES])
async def test_the_end_is_told_whenever_it_comes(pair: Pair, size: int) -> None:
    recorder, _, far = pair
    far.sendall(bytes(size))
    await until(lambda: len(recorder.received) == size)
    far.shutdown(socket.SHUT_WR)
    await until(recorder.lost.is_set)


async def test_what_came_while_nothing_was_read_is_read_afterwards(pair: Pair) -> None:
    recorder, transport, far = pair
    transport.pause_reading()
    far.sendall(bytes(READ_BYTES))
    far.shutdown(socket.SHUT_WR)
    for _ in range(20):
        await asyncio.sleep(0)
    assert recorder.told == ["made"]
    transport.resume_reading()
    await until(recorder.lost.is_set)
    assert len(recorder.received) == READ_BYTES


async def test_bytes_that_come_while_replies_wait_are_all_read(pair: Pair) -> None:
    recorder, transport, far = pair
    transport.write(bytes(16_000_000))
    for _ in range(20):
        await asyncio.sleep(0)
    far.setblocking(False)
    with contextlib.suppress(BlockingIOError):
        while far.recv(1_000_000):  # now the kernel takes more; both are told of in one turn
            pass
    far.sendall(bytes(3 * READ_BYTES))
    await until(lambda: len(recorder.received) == 3 * READ_BYTES)
    assert transport.get_write_buffer_size() > 0
    transport.abort()


async def test_a_protocol_that_fails_takes_nothing_from_the_others(hub: Hub, opened: list[socket.socket]) -> None:
    pairs = [connected(hub, opened) for _ in range(4)]
    failures: list[dict[str, object]] = []
    asyncio.get_running_loop().set_exception_handler(lambda _, context: failures.append(context))

    def fail(_: bytes) -> None:
        message = "a bug"
        raise ValueError(message)

    for recorder, _, far in pairs[:2]:
        recorder.answer = fail
        far.sendall(b"?")
    for _, _, far in pairs[2:]:
        far.sendall(b"?")
    await until(lambda: all(recorder.received == b"?" for recorder, _, _ in pairs))
    assert len(failures) == 2
    for _, transport, _ in pairs:
        transport.abort()


async def test_what_the_kernel_does_not_take_follows_in_order(pair: Pair) -> None:
    recorder, transport, far = pair
    transport.set_write_buffer_limits(high=8192)
    sent = b""
    while "pause" not in recorder.told:
        piece = os.urandom(3000)
        transport.write(piece)
        sent += piece
    assert transport.get_write_buffer_size() > 8192
    transport.write(b"the end")
    sent += b"the end"
    got = b""
    async with asyncio.timeout(30):
        while len(got) < len(sent):
            got += await asyncio.to_thread(far.recv, 65536)
    assert got == sent
    await until(lambda: "resume" in recorder.told)
    assert recorder.told == ["made", "pause", "resume"]
    assert transport.get_write_buffer_size() == 0
    transport.abort()


async def test_close_sends_the_rest_first_and_then_ends(pair: Pair) -> None:
    recorder, transport, far = pair
    sent = 0
    while not transport.get_write_buffer_size():
        transport.write(bytes(65536))
        sent += 65536
    transport.close()
    transport.write(b"too late")
    assert transport.is_closing()
    got = 0
    async with asyncio.timeout(30):
        while piece := await asyncio.to_thread(far.recv, 65536):
            got += len(piece)
    assert got == sent
    await recorder.lost.wait()


async def test_a_protocol_that_closes_in_its_own_call_is_told_later(pair: Pair) -> None:
    recorder, transport, far = pair
    inside: list[bool] = []

    def answer(data: bytes) -> None:
        transport.write(data)
        transport.close()
        transport.abort()
        inside.append(recorder.lost.is_set())

    recorder.answer = answer
    far.sendall(b"question")
    await recorder.lost.wait()
    assert inside == [False]
    assert recorder.told == ["made", "data", "lost"]
    assert far.recv(100) == b"question"


@pytest.mark.parametrize("stay_open", [False, True])
async def test_end_of_stream_is_told_once(pair: Pair, stay_open: bool) -> None:
    recorder, transport, far = pair
    recorder.stay_open = stay_open
    far.sendall(b"last words")
    far.shutdown(socket.SHUT_WR)
    await until(lambda: "eof" in recorder.told)
    if stay_open:
        await asyncio.sleep(0.01)
        assert recorder.told == ["made", "data", "eof"]
        transport.write(b"answer")
        assert far.recv(100) == b"answer"
        transport.close()
    await recorder.lost.wait()
    assert recorder.told == ["made", "data", "eof", "lost"]


async def test_nothing_is_read_while_reading_is_paused(pair: Pair) -> None:
    recorder, transport, far = pair
    transport.pause_reading()
    far.sendall(b"wait")
    await asyncio.sleep(0.01)
    assert recorder.told == ["made"]
    transport.resume_reading()
    await until(lambda: bytes(recorder.received) == b"wait")
    transport.abort()


async def test_a_reset_is_noticed_also_while_reading_is_paused(pair: Pair) -> None:
    recorder, transport, far = pair
    transport.pause_reading()
    reset(far)
    await asyncio.wait_for(recorder.lost.wait(), 10)
    transport.write(b"to nobody")
    assert recorder.told == ["made", "lost"]


async def test_writing_to_a_peer_that_has_reset_ends_the_connection(pair: Pair) -> None:
    recorder, transport, far = pair
    reset(far)
    while not transport.is_closing():
        transport.write(b"x")
    await recorder.lost.wait()
    assert recorder.told[-1] == "lost"


async def test_a_busy_client_does_not_keep_the_loop_from_others(hub: Hub, opened: list[socket.socket]) -> None:
    """More ready clients than a turn serves: all are served, and the loop runs other callbacks in between."""
    recorders = []
    with socket.create_server(("127.0.0.1", 0), backlog=4 * TURN) as server:
        for _ in range(2 * TURN):
            far = socket.create_connection(server.getsockname(), 10)
            far.sendall(bytes(10 * READ_BYTES))
            near, peername = server.accept()
            near.settimeout(0.0)
            opened.append(far)
            recorders.append(Recorder())
            SocketTransport(hub, near, peername, recorders[-1])
    turns = 0
    while min(len(recorder.received) for recorder in recorders) < 10 * READ_BYTES:
        await asyncio.sleep(0)
        turns += 1
    assert turns >= 15
    for recorder in recorders:
        assert recorder.transport is not None
        recorder.transport.abort()
    await recorders[-1].lost.wait()


async def test_what_is_not_taken_is_thrown_away_with_the_connection(pair: Pair) -> None:
    """Otherwise the kernel would keep it, and try for minutes to have a client that reads nothing take it."""
    recorder, transport, far = pair
    while "pause" not in recorder.told:
        transport.write(bytes(65536))
    transport.abort()
    await recorder.lost.wait()
    with pytest.raises(ConnectionResetError):
        await asyncio.to_thread(read_to_the_end, far)


async def test_the_hub_is_gone_with_its_last_descriptor(pair: Pair, hub: Hub) -> None:
    recorder, transport, _ = pair
    epoll, sock = hub._epoll, transport._sock
    assert epoll is not None
    transport.abort()
    await recorder.lost.wait()
    assert hub._epoll is None
    assert epoll.closed
    assert sock.fileno() == -1


async def test_f81_without_descriptors_accepting_pauses_and_goes_on(
    hub: Hub, opened: list[socket.socket], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    taken: list[socket.socket] = []
    listening = await listening_socket("127.0.0.1", 0, send_buffer=4096)
    acceptor = Acceptor(hub, listening, "modbus here", lambda sock, _: taken.append(sock))
    with monkeypatch.context() as patch:
        patch.setattr("gateway.faces.modbus.accepting.SPARE_DESCRIPTORS", 1 << 30)
        patch.setattr("gateway.faces.modbus.accepting.ACCEPT_PAUSE_S", 0.05)
        refused = socket.create_connection(listening.getsockname(), 10)
        assert refused.recv(1) == b"" if await closes(refused) else False
        waiting = socket.create_connection(listening.getsockname(), 10)
        assert not taken
    await until(lambda: len(taken) == 1)
    opened += [refused, waiting, *taken]
    assert 1 <= acceptor.pauses <= 2
    assert ACCEPT_PAUSE_S == 1.0
    assert "accept_paused" in caplog.text
    acceptor.close()
    assert hub._epoll is None


async def closes(sock: socket.socket) -> bool:
    """Whether the other end closes the connection without a word."""
    return await asyncio.to_thread(sock.recv, 1, socket.MSG_PEEK) == b""
