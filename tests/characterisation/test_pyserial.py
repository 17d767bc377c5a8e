"""What of pyserial our lines work around, and what they rely on (gateway/lines/ports.py, transports.py).

Each xfail says what should happen. It fails on pyserial 3.5; the day it passes, upstream was fixed.
"""

from __future__ import annotations

import contextlib
import errno
import io
import os
import pty
import socket
from collections.abc import Iterator

import pytest
import serial
from serial import rfc2217


@pytest.fixture
def terminal() -> Iterator[tuple[int, str]]:
    """The master of a pty, and where its other end is."""
    master, slave = pty.openpty()
    path = os.ttyname(slave)
    os.close(slave)
    yield master, path
    os.close(master)


def fails(why: str) -> pytest.MarkDecorator:
    return pytest.mark.xfail(raises=AssertionError, strict=True, reason=f"pyserial 3.5 {why}")


def test_the_bench_is_sound(terminal: tuple[int, str]) -> None:
    master, path = terminal
    with serial.Serial(path, timeout=0) as port:
        os.write(master, b"abc")
        port.timeout = 5
        assert port.read(3) == b"abc"


@fails("lets an empty read of its descriptor mean that nothing came, too")
def test_an_empty_read_means_that_the_port_is_gone(terminal: tuple[int, str]) -> None:
    with serial.Serial(terminal[1], timeout=0) as port:
        os.set_blocking(port.fileno(), False)
        found: bytes | None = None
        with contextlib.suppress(BlockingIOError):
            found = os.read(port.fileno(), 10)
        assert found is None


@fails("does not close a connection whose other end was gone before")
def test_a_closed_connection_is_closed() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = serial.serial_for_url(f"socket://127.0.0.1:{server.getsockname()[1]}", timeout=1)
        other, _ = server.accept()
        connection: socket.socket = vars(port)["_socket"]
        other.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")
        other.close()
        with pytest.raises((serial.SerialException, OSError)):
            port.read(1)
        port.close()
        try:
            assert connection.fileno() == -1
        finally:
            connection.close()


def test_a_locked_port_is_refused_with_the_systems_own_number(terminal: tuple[int, str]) -> None:
    with (
        serial.Serial(terminal[1], exclusive=True),
        pytest.raises(serial.SerialException, match="exclusively lock") as refused,
    ):
        serial.Serial(terminal[1], exclusive=True)
    assert refused.value.errno in {errno.EAGAIN, errno.EWOULDBLOCK}


def test_a_port_that_has_no_latency_to_set_says_so_in_a_way_that_we_expect(terminal: tuple[int, str]) -> None:
    with serial.Serial(terminal[1]) as port, pytest.raises((OSError, ValueError, NotImplementedError, AttributeError)):
        port.set_low_latency_mode(True)


def test_a_port_by_rfc2217_has_no_descriptor() -> None:
    with pytest.raises(io.UnsupportedOperation):
        rfc2217.Serial().fileno()
