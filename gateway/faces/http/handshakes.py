"""The way in by TLS: sockets that shake hands, and are no connections yet.

Rule 1: at most `most` shake hands at once. When one more comes, the one that began first makes room, so that strangers
        who never finish can neither pile up nor keep a scraper out.
Rule 2: a handshake that is not done after `timeout_s`, or fails, ends its socket and nothing else.
Rule 3: without descriptors nothing is accepted for `ACCEPT_PAUSE_S`; who wants in waits in the kernel's queue.
"""

from __future__ import annotations

import asyncio
import errno
import socket
import ssl
from collections.abc import Callable

from gateway.faces.http.connection import Connection
from gateway.faces.http.own import HttpStats

ACCEPT_TURN = 32
ACCEPT_PAUSE_S = 1.0

_NO_DESCRIPTORS = (errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM)


class Handshakes:
    """A listening socket; `protocol` makes what serves a connection. `most`, `timeout_s` and `tls` may be changed."""

    def __init__(
        self,
        tls: ssl.SSLContext,
        stats: HttpStats,
        *,
        most: int,
        timeout_s: float,
        protocol: Callable[[], Connection],
    ) -> None:
        self.most = most
        self.timeout_s = timeout_s
        self.tls = tls
        self._stats = stats
        self._protocol = protocol
        self._sock: socket.socket | None = None
        # The one that began first comes first; its socket is here until the loop's transport has it.
        self._pending: dict[asyncio.Task[None], socket.socket | None] = {}
        self._pause: asyncio.TimerHandle | None = None

    @property
    def bound(self) -> tuple[str, int] | None:
        """Address and port really listened on; None while closed."""
        if self._sock is None:
            return None
        host, port, *_ = self._sock.getsockname()
        return host, port

    def open(self, sock: socket.socket) -> None:
        """Accept what comes to a socket that listens; it is ours from now on."""
        self._sock = sock
        asyncio.get_running_loop().add_reader(sock, self._accept)

    async def close(self) -> None:
        """Accept no more, and end what has not come in; connections go on."""
        sock, self._sock = self._sock, None
        if self._pause is not None:
            self._pause.cancel()
            self._pause = None
        if sock is not None:
            asyncio.get_running_loop().remove_reader(sock)
            sock.close()
        pending = tuple(self._pending)
        for task in pending:
            self._end(task)
        await asyncio.gather(*pending, return_exceptions=True)

    def _accept(self) -> None:
        for _ in range(ACCEPT_TURN):
            if self._sock is None:
                return
            try:
                sock, _ = self._sock.accept()
            except (BlockingIOError, InterruptedError):
                return
            except OSError as error:
                if error.errno in _NO_DESCRIPTORS:
                    self._wait(self._sock)
                    return
                continue  # that one went before it was accepted
            self._begin(sock)

    def _begin(self, sock: socket.socket) -> None:
        self._stats.connections += 1
        sock.settimeout(0.0)
        if len(self._pending) >= self.most:  # rule 1
            self._end(next(iter(self._pending)))
            self._stats.closed_for_room += 1
        task = asyncio.get_running_loop().create_task(self._shake_hands(sock))
        self._pending[task] = sock
        task.add_done_callback(lambda done: self._pending.pop(done, None))

    def _end(self, task: asyncio.Task[None]) -> None:
        sock = self._pending.pop(task)
        task.cancel()
        if sock is not None:
            sock.close()

    async def _shake_hands(self, sock: socket.socket) -> None:
        task = asyncio.current_task()
        assert task is not None
        self._pending[task] = None
        connection = self._protocol()
        try:
            await asyncio.get_running_loop().connect_accepted_socket(
                lambda: connection, sock, ssl=self.tls, ssl_handshake_timeout=self.timeout_s
            )
        except OSError:  # TLS errors and time-outs are among them
            pass
        except asyncio.CancelledError:
            connection.abort()  # which has come in, if the handshake was done in this turn, and would end politely
            raise

    def _wait(self, sock: socket.socket) -> None:
        loop = asyncio.get_running_loop()
        loop.remove_reader(sock)
        self._pause = loop.call_later(ACCEPT_PAUSE_S, self._again)

    def _again(self) -> None:
        self._pause = None
        if self._sock is not None:
            asyncio.get_running_loop().add_reader(self._sock, self._accept)
