"""Looking for controllers on a port whose clock the test moves, and behind a server that closes."""

from __future__ import annotations

import socket
import threading

import pytest

from gateway.lines import scan
from gateway.lines.looking import PROBE, Found
from gateway.lines.scan import Scanner
from gateway.lines.scan_tcp import TcpScanner
from gateway.modbus.crc import append_crc
from gateway.modbus.rtu import Timing

TIMING = Timing.of(9600, 8, "N", 2)


class Stalled:
    """A port whose only controller answers at once, to a program that a busy machine lets wait at every look."""

    timeout = 0.0

    def __init__(self) -> None:
        self.now = 0.0
        self.data = self.answer = b""

    def monotonic(self) -> float:
        return self.now

    @property
    def in_waiting(self) -> int:
        return len(self.data)

    def write(self, frame: bytes) -> None:
        self.answer = append_crc(bytes((frame[0], 3, 2, 0, 7))) if frame[1:-2] == PROBE else b""

    def read(self, size: int) -> bytes:
        data, self.data = self.data[:size], self.data[size:]
        self.now += 10.0  # so long that everything is late
        self.data, self.answer = self.data + self.answer, b""
        return data


def test_nobody_is_silent_whose_answer_is_there(monkeypatch: pytest.MonkeyPatch) -> None:
    port = Stalled()
    monkeypatch.setattr(scan, "time", port)
    scanner = Scanner(port, TIMING, 0.2, lambda: False)  # type: ignore[arg-type]  # what is used of it
    assert [step.found for step in scanner.walk(9600, [5])] == [Found(9600, 5)]


def closing_late(server: socket.socket) -> None:
    """Answer one request a connection, and close the first one only when it was asked once more."""
    for number in range(3):
        connection, _ = server.accept()
        with connection:
            request = connection.recv(300)
            connection.sendall(request[:4] + b"\0\x05" + request[6:8] + b"\x02\0\x07")
            if number == 0:
                connection.recv(300)


def test_who_closed_at_this_moment_is_asked_again() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        answering = threading.Thread(target=closing_late, args=(server,), daemon=True)
        answering.start()
        scanner = TcpScanner("127.0.0.1", server.getsockname()[1], 30.0, lambda: False)
        assert isinstance(scanner._ask(1, PROBE, 30.0), bytes)
        assert isinstance(scanner._ask(2, PROBE, 30.0), bytes)
        assert isinstance(scanner._ask(3, PROBE, 30.0), bytes)
        scanner.close()
        answering.join()
