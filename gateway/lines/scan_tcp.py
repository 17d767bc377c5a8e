"""Looking for controllers behind a Modbus TCP server: every unit id that is asked for, one after the other.

Rule 1: what is asked is the same on every line (looking.py).
Rule 2: nobody is at a unit id of which the server says 0A or 0B, or nothing within the time-out. Any other exception is
        a controller's.
Rule 3: a connection that the server closed after a reply is made anew. One on which a reply did not come, or not the
        right one, is ended, so that no late reply is taken for the next. One that was used before and is closed in
        place of a reply was closed after the last one, as we asked: the question is put once more, on a new one.
"""

from __future__ import annotations

import contextlib
import os
import socket
import time
from collections.abc import Callable, Iterator, Sequence

from gateway.errors import PortError, ReplyMismatch, RequestError
from gateway.lines.looking import Looker, ScanStopped, Step
from gateway.modbus.mbap import Adu, MbapSplitter, encode
from gateway.modbus.pdu import is_exception, reply_fits

LOOK_S = 0.1
"""How long one look at the connection takes."""
CONNECT_S = 5.0
_NOBODY = (0x0A, 0x0B)


class _ClosedError(Exception):
    """The server ended the connection in place of a reply."""


class TcpScanner(Looker):
    """Asks a server, and blocks while it does; `close` it in the end.

    `stopping` is asked all the time; once it is true, ScanStopped is raised. PortError when there is no connection.
    """

    def __init__(self, host: str, port: int, timeout_s: float, stopping: Callable[[], bool]) -> None:
        self._where = (host, port)
        self._timeout_s = timeout_s
        self._stopping = stopping
        self._sock: socket.socket | None = None
        self._tid = 0

    def walk(self, units: Sequence[int]) -> Iterator[Step]:
        """Ask every unit id in turn."""
        for unit in units:
            yield Step(0, unit, self._look(0, unit, self._timeout_s))

    def close(self) -> None:
        """End the connection."""
        if self._sock is not None:
            self._sock.close()
            self._sock = None

    def _ask(self, address: int, pdu: bytes, timeout_s: float) -> bytes | RequestError | None:
        """See `Looker._ask`."""
        before = self._sock
        self._tid = (self._tid + 1) & 0xFFFF
        sock = self._connected()
        with contextlib.suppress(OSError):  # it was closed at this moment: the read finds that
            sock.sendall(encode(self._tid, address, pdu))
        try:
            adu = self._receive(sock, time.monotonic() + timeout_s)
        except _ClosedError:
            self.close()
            return self._ask(address, pdu, timeout_s) if sock is before else None
        if adu is None:
            self.close()
            return None
        if (adu.tid, adu.unit) != (self._tid, address) or not reply_fits(pdu, adu.pdu):
            self.close()
            return ReplyMismatch(f"unit {address} answered something else than it was asked")
        if is_exception(adu.pdu) and adu.pdu[1] in _NOBODY:
            return None
        return adu.pdu

    def _connected(self) -> socket.socket:
        if self._sock is not None:
            self._sock.settimeout(0.0)
            try:
                self._sock.recv(1)  # nothing is due: it is closed, or not to be trusted
            except BlockingIOError:
                self._sock.settimeout(LOOK_S)
                return self._sock
            except OSError:
                pass
            self.close()
        if self._stopping():
            raise ScanStopped
        try:
            self._sock = socket.create_connection(self._where, CONNECT_S)
        except OSError as error:
            reason = str(error) if error.errno is None or error.errno < 0 else os.strerror(error.errno).lower()
            raise PortError(reason) from error
        self._sock.settimeout(LOOK_S)
        return self._sock

    def _receive(self, sock: socket.socket, until: float) -> Adu | None:
        splitter = MbapSplitter()
        while time.monotonic() < until:
            if self._stopping():
                raise ScanStopped
            try:
                data = sock.recv(4096)
            except TimeoutError:
                continue
            except OSError as error:
                raise _ClosedError from error
            if not data:
                raise _ClosedError
            adus = splitter.feed(data)
            if adus:
                return adus[0]
            if splitter.lost is not None:
                return None
        return None
