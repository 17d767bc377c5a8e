"""One address that the HTTP face listens on, and its connections (connection.py).

With TLS a connection counts from the end of its handshake; as many more may be shaking hands (handshakes.py), each for
`idle_timeout_s` at most.
"""

from __future__ import annotations

import asyncio
import ssl
from collections.abc import Callable

from gateway.clock import Clock
from gateway.errors import ListenError
from gateway.faces.binding import BACKLOG, bind_problem, listening_socket
from gateway.faces.http.access import tls_context
from gateway.faces.http.connection import Connections
from gateway.faces.http.handshakes import Handshakes
from gateway.faces.http.own import HttpStats
from gateway.faces.http.request import Handler
from gateway.faces.http.settings import HttpSettings

SEND_BUFFER = 128 * 1024
"""Octets on the way to a client: enough for ten megabits a second over a tenth of a second."""


class HttpListener:
    """Answers requests on one address; can be started again after a stop or a failed start."""

    def __init__(
        self,
        host: str,
        port: int,
        handler: Callable[[], Handler],
        settings: HttpSettings,
        *,
        clock: Clock,
        stats: HttpStats,
    ) -> None:
        """`handler` gives, for each start, what answers requests, or raises ListenError."""
        self.label = f"http [{host}]:{port}" if ":" in host else f"http {host}:{port}"
        self._host = host
        self._port = port
        self._handler = handler
        self._settings = settings
        self._clock = clock
        self._stats = stats
        self._connections: Connections | None = None
        self._server: asyncio.Server | None = None
        self._handshakes: Handshakes | None = None  # with TLS, instead of a server
        self.key = (host, port, bool(settings.tls_certificate))
        """Two listeners that agree in this are the same."""

    @property
    def bound(self) -> tuple[str, int] | None:
        """Address and port really listened on; None while stopped."""
        if self._handshakes is not None:
            return self._handshakes.bound
        if self._server is None or not self._server.sockets:
            return None
        host, port, *_ = self._server.sockets[0].getsockname()
        return host, port

    async def start(self) -> None:
        """Listen; ListenError names the address and why it cannot."""
        if self._server is not None or self._handshakes is not None:
            return
        try:
            handler, tls = self._handler(), tls_context(self._settings)
        except ListenError as error:
            raise ListenError(f"{self.label}: {error}") from None
        self._connections = connections = Connections(self._settings, handler, self._clock, self._stats)
        try:
            sock = await listening_socket(self._host, self._port, send_buffer=SEND_BUFFER)
            if tls is None:
                self._server = await asyncio.get_running_loop().create_server(self._accept, sock=sock, backlog=BACKLOG)
            else:
                self._handshakes = self._way_in(tls, connections)
                self._handshakes.open(sock)
        except OSError as error:
            await self.stop()
            raise ListenError(f"{self.label}: {bind_problem(error)}") from error
        except asyncio.CancelledError:
            await self.stop()
            raise

    def adjust(self, settings: HttpSettings, tls: ssl.SSLContext | None) -> None:
        """Go on by other settings; `tls` is for the handshakes from now on, None: that of before."""
        self._settings = settings
        if self._connections is not None:
            self._connections.settings = settings
        if self._handshakes is not None:
            self._handshakes.most, self._handshakes.timeout_s = settings.max_connections, settings.idle_timeout_s
            self._handshakes.tls = tls or self._handshakes.tls

    async def stop(self) -> None:
        """Stop listening and close every connection; replies under way have `stop_grace_s`."""
        server, self._server = self._server, None
        connections, self._connections = self._connections, None
        if server is not None:
            server.close()
        handshakes, self._handshakes = self._handshakes, None
        if handshakes is not None:
            await handshakes.close()
        if connections is not None:
            await connections.close()
        if server is not None:
            await server.wait_closed()

    def _way_in(self, tls: ssl.SSLContext, connections: Connections) -> Handshakes:
        return Handshakes(
            tls,
            self._stats,
            most=self._settings.max_connections,
            timeout_s=self._settings.idle_timeout_s,
            protocol=connections,
        )

    def _accept(self) -> asyncio.Protocol:
        assert self._connections is not None
        self._stats.connections += 1
        return self._connections()
