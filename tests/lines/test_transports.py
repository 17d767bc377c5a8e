"""Bytes between a port and its line: no byte lost, none waited for in a busy loop, each failure told once."""

from __future__ import annotations

import asyncio
import contextlib
import os
import pty
import socket
import threading
import time
import tty
from collections.abc import Callable, Iterator

import pytest
import serial

from gateway.lines.threads import in_thread
from gateway.lines.transports import LONGEST_PAUSE_S, FileTransport, ThreadTransport, transport_for
from tests.lines.rig import until
from tests.machine import Bystander

CHAR_S = 11 / 9600


class Owner:
    """A line that notes what it is told; `due` is what it waits for."""

    def __init__(self) -> None:
        self.looks: list[bytes] = []
        self.failures: list[str] = []
        self.due = 0

    def on_bytes(self, data: bytes) -> None:
        self.looks.append(data)
        self.due = max(0, self.due - len(data))

    def on_failure(self, reason: str) -> None:
        self.failures.append(reason)

    def bytes_due(self) -> int:
        return self.due


@pytest.fixture
def owner() -> Owner:
    return Owner()


@pytest.fixture
def ends() -> Iterator[tuple[socket.socket, socket.socket]]:
    near, far = socket.socketpair()
    with near, far:
        yield near, far


async def test_a_long_reply_takes_a_few_looks(owner: Owner, ends: tuple[socket.socket, socket.socket]) -> None:
    near, far = ends
    transport = FileTransport(near.fileno(), asyncio.get_running_loop(), owner, CHAR_S)
    transport.start()
    owner.due = 169
    transport.write(bytes(8))
    began, sent = time.monotonic(), 0
    while sent < 169:  # byte by byte, each in its time: the wire does not wait for a busy machine
        await asyncio.sleep(CHAR_S)
        due = min(169, int((time.monotonic() - began) / CHAR_S))
        sent += far.send(b"x" * (due - sent))
    await until(lambda: owner.due == 0)
    transport.stop()
    assert far.recv(100) == bytes(8)
    assert b"".join(owner.looks) == b"x" * 169
    assert len(owner.looks) < 60  # the far end is up to a millisecond late at each byte, so the end is looked for early


async def test_bytes_of_a_batch_are_not_waited_for_at_the_lines_speed(
    owner: Owner, ends: tuple[socket.socket, socket.socket]
) -> None:
    """A reply that the adapter held back is whole in two looks, however many bytes the second brings."""
    near, far = ends
    transport = FileTransport(near.fileno(), asyncio.get_running_loop(), owner, CHAR_S)
    transport.start()
    owner.due = 100
    far.send(bytes(20))
    await until(lambda: bool(owner.looks))
    await asyncio.sleep(70 * CHAR_S)
    far.send(bytes(70))  # 10 are missing, and come at once
    await until(lambda: len(owner.looks) == 2)
    far.send(bytes(10))
    assert transport.take() == b""  # the reader is awake: it takes them as soon as the loop turns
    await until(lambda: owner.due == 0)
    transport.stop()


async def test_what_is_there_can_be_taken_while_the_reader_sleeps(
    owner: Owner, ends: tuple[socket.socket, socket.socket]
) -> None:
    near, far = ends
    transport = FileTransport(near.fileno(), asyncio.get_running_loop(), owner, CHAR_S)
    transport.start()
    assert transport.take() == b""  # awake: it reads by itself
    owner.due = 250
    far.send(b"a")
    await until(lambda: bool(owner.looks))
    far.send(b"bc")
    assert transport.take() == b"bc"
    assert transport.take() == b""
    transport.stop()
    assert transport.take() == b""


async def test_a_write_that_the_kernel_takes_in_parts_loses_nothing_and_does_not_spin(
    owner: Owner, ends: tuple[socket.socket, socket.socket]
) -> None:  # F20
    near, far = ends
    near.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1)
    transport = FileTransport(near.fileno(), asyncio.get_running_loop(), owner, CHAR_S)
    transport.start()
    sent = bytes(range(256)) * 2000
    transport.write(sent)
    used = time.process_time()
    await asyncio.sleep(0.3)  # nobody reads: the rest has to wait
    assert time.process_time() - used < 0.1
    got = b""
    far.setblocking(False)
    while len(got) < len(sent):
        with contextlib.suppress(BlockingIOError):
            got += far.recv(65536)
        await asyncio.sleep(0)
    transport.stop()
    assert got == sent
    assert owner.failures == []


async def test_what_was_not_taken_is_not_sent_when_the_next_frame_is_due(
    owner: Owner, ends: tuple[socket.socket, socket.socket]
) -> None:
    near, far = ends
    near.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1)
    transport = FileTransport(near.fileno(), asyncio.get_running_loop(), owner, CHAR_S)
    transport.start()
    transport.write(b"old" * 100_000)
    transport.write(b"new")
    assert owner.failures == ["the other end takes no more requests"]
    transport.write(b"newer")
    got = b""
    far.setblocking(False)
    for _ in range(10):
        await asyncio.sleep(0)
        with contextlib.suppress(BlockingIOError):
            got += far.recv(1 << 20)
    assert 0 < len(got) < 300_000
    assert b"new" not in got
    assert owner.failures == ["the other end takes no more requests"]


@pytest.mark.parametrize("asleep", [False, True])
async def test_a_device_that_goes_is_told_once_and_within_a_second(owner: Owner, asleep: bool) -> None:  # F16
    master, slave = pty.openpty()
    tty.setraw(slave)
    transport = FileTransport(slave, asyncio.get_running_loop(), owner, 0.1)  # a slow line: 25 s for a reply
    transport.start()
    if asleep:
        owner.due = 250
        os.write(master, b"x")
        await until(lambda: bool(owner.looks))
    os.close(master)
    with Bystander() as passing:
        await until(lambda: bool(owner.failures))
    assert passing.s < 10.0  # not when the reply is due; what is promised is the longest pause
    assert LONGEST_PAUSE_S < 1.0
    transport.write(b"late")
    await asyncio.sleep(0.05)
    assert len(owner.failures) == 1
    os.close(slave)


class Port:
    """A port without a descriptor, as pyserial's `rfc2217://`."""

    timeout = 0.0

    def __init__(self, read: Callable[[], bytes], write: Callable[[bytes], None] = lambda _frame: None) -> None:
        self._read = read
        self._write = write
        self.in_waiting = 0

    def read(self, size: int) -> bytes:
        return self._read() if size else b""

    def write(self, frame: bytes) -> None:
        self._write(frame)


def idle() -> bytes:
    time.sleep(0.01)
    return b""


def on_threads(port: Port, owner: Owner) -> ThreadTransport:
    made = transport_for(port, asyncio.get_running_loop(), owner, char_s=CHAR_S, name="line")  # type: ignore[arg-type]  # what is used of it
    assert isinstance(made, ThreadTransport)
    made.start()
    return made


@pytest.mark.parametrize("error", [TypeError("closed"), AttributeError("closed"), OSError("closed")])
async def test_whatever_pyserial_raises_is_a_failure_told_once(owner: Owner, error: Exception) -> None:
    def fail() -> bytes:
        raise error

    transport = on_threads(Port(fail), owner)
    await until(lambda: bool(owner.failures))
    transport.stop()
    assert owner.failures == ["closed"]


async def test_a_network_that_takes_nothing_more_is_a_failure_and_blocks_nobody(owner: Owner) -> None:
    stuck = threading.Event()

    def hang(_frame: bytes) -> None:
        stuck.wait(60)

    transport = on_threads(Port(idle, hang), owner)
    with Bystander() as passing:
        for _ in range(8):
            transport.write(bytes(8))
    assert passing.s < 4.0
    stuck.set()
    assert owner.failures == ["the other end takes no more requests"]


async def test_nothing_is_told_after_the_end(owner: Owner) -> None:
    transport = on_threads(Port(lambda: b"x"), owner)
    await until(lambda: bool(owner.looks))
    transport.stop()
    seen = len(owner.looks)
    await asyncio.sleep(0.05)
    assert len(owner.looks) == seen


async def test_written_frames_arrive_in_order(owner: Owner) -> None:
    frames: list[bytes] = []
    transport = on_threads(Port(idle, frames.append), owner)
    for number in range(3):
        transport.write(bytes([number]))
    await until(lambda: len(frames) == 3)
    transport.stop()
    assert frames == [b"\0", b"\1", b"\2"]


async def test_the_result_of_a_call_that_nobody_waits_for_is_given_away() -> None:
    may_end = threading.Event()
    late: list[int] = []

    def work() -> int:
        may_end.wait(60)
        return 7

    future = in_thread(work, late=late.append, name="test")
    future.cancel()
    may_end.set()
    await until(lambda: late == [7])


def test_the_result_of_a_call_that_outlives_the_loop_is_given_away() -> None:
    may_end = threading.Event()
    done = threading.Event()

    async def leave() -> None:
        in_thread(lambda: may_end.wait(60), late=lambda _result: done.set(), name="test")

    asyncio.run(leave())
    may_end.set()
    assert done.wait(60)


async def test_what_a_call_raises_is_raised_to_who_waits() -> None:
    def fail() -> None:
        raise serial.SerialException("busy")

    with pytest.raises(serial.SerialException, match="busy"):
        await in_thread(fail, late=lambda _none: None, name="test")
