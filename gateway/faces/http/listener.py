"""One address that the HTTP face listens on.

Rules: a connection that sends no whole request header, or no further request, within `idle_timeout_s` is
closed. At most `max_connections` are kept: when one more comes, the one that has been open longest and has
nothing left to send makes room, so that idle strangers cannot keep a scraper out. With TLS a connection counts
from the end of its handshake; as many more may be shaking hands (handshakes.py), each for `idle_timeout_s` at most.
"""

from __future__ import annotations

import asyncio
import os
import ssl
from collections.abc import Callable

from aiohttp import web

from gateway.errors import ListenError
from gateway.faces.http.access import load_certificate, tls_context
from gateway.faces.http.handshakes import Handshakes
from gateway.faces.http.own import HttpStats
from gateway.faces.http.settings import HttpSettings

_BURST_S = 0.05  # connections that came in one turn of the loop are counted so long after


class HttpListener:
    """Serves an application on one address; can be started again after a stop or a failed start."""

    def __init__(
        self,
        host: str,
        port: int,
        application: Callable[[], web.Application],
        settings: HttpSettings,
        stats: HttpStats,
    ) -> None:
        """`application` makes the application, which aiohttp wants anew for each start, or raises ListenError."""
        self.label = f"http [{host}]:{port}" if ":" in host else f"http {host}:{port}"
        self._host = host
        self._port = port
        self._application = application
        self._settings = settings
        self._stats = stats
        self._runner: web.AppRunner | None = None
        self._server: asyncio.Server | None = None
        self._handshakes: Handshakes | None = None  # with TLS, instead of a server
        self._tls: ssl.SSLContext | None = None
        self.key = (host, port, bool(settings.tls_certificate))
        """Two listeners that agree in this are the same."""
        self._recount: asyncio.TimerHandle | None = None

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
            application, tls = self._application(), tls_context(self._settings)
        except ListenError as error:
            raise ListenError(f"{self.label}: {error}") from None
        self._tls = tls
        runner = web.AppRunner(
            application,
            access_log=None,
            keepalive_timeout=self._settings.idle_timeout_s,
            lingering_time=0,  # nobody has anything to send here
            shutdown_timeout=self._settings.stop_grace_s,
        )
        await runner.setup()
        self._runner = runner
        try:
            if tls is None:
                loop = asyncio.get_running_loop()
                self._server = await loop.create_server(self._accept, self._host, self._port)
            else:
                self._handshakes = self._way_in(tls)
                self._handshakes.open(self._host, self._port)
        except OSError as error:
            await self.stop()
            reason = os.strerror(error.errno) if error.errno and error.errno > 0 else error.strerror
            raise ListenError(f"{self.label}: {reason or error}") from error
        except asyncio.CancelledError:
            await self.stop()
            raise

    def adjust(self, settings: HttpSettings) -> None:
        """Go on by other settings, with what the certificate files hold now; ListenError when they are of no use."""
        self._settings = settings
        if self._handshakes is not None:
            self._handshakes.most, self._handshakes.timeout_s = settings.max_connections, settings.idle_timeout_s
        if self._tls is not None:
            load_certificate(self._tls, settings)

    async def stop(self) -> None:
        """Stop listening and close every connection; replies under way have `stop_grace_s`."""
        server, self._server = self._server, None
        runner, self._runner = self._runner, None
        if self._recount is not None:
            self._recount.cancel()
            self._recount = None
        if server is not None:
            server.close()
        handshakes, self._handshakes = self._handshakes, None
        if handshakes is not None:
            await handshakes.close()
        if runner is not None:
            await runner.cleanup()
        if server is not None:
            await server.wait_closed()

    def _way_in(self, tls: ssl.SSLContext) -> Handshakes:
        assert self._runner is not None
        assert self._runner.server is not None
        return Handshakes(
            tls,
            self._stats,
            most=self._settings.max_connections,
            timeout_s=self._settings.idle_timeout_s,
            protocol=self._runner.server,
            entered=lambda: self._make_room(self._settings.max_connections),
        )

    def _accept(self) -> asyncio.Protocol:
        assert self._runner is not None
        assert self._runner.server is not None
        self._stats.connections += 1
        self._make_room(self._settings.max_connections - 1)
        if self._recount is None:
            self._recount = asyncio.get_running_loop().call_later(_BURST_S, self._count_again)
        return self._runner.server()

    def _count_again(self) -> None:
        self._recount = None
        self._make_room(self._settings.max_connections)

    def _make_room(self, limit: int) -> None:
        assert self._runner is not None
        assert self._runner.server is not None
        live = [
            (connection, connection.transport)
            for connection in self._runner.server.connections  # oldest first
            if connection.transport is not None
        ]
        surplus = len(live) - limit
        for connection, transport in live:
            if surplus <= 0:
                return
            if transport.get_write_buffer_size() == 0:
                connection.force_close()
                self._stats.closed_for_room += 1
                surplus -= 1
