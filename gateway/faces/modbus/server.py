"""The Modbus TCP face: its listeners, and which connections there are.

Rule 1: a client that is not in `allow` is cut off before a byte of it is read.
Rule 2: who gets in, and who makes room, is decided by admission.py.
Rule 3: once a second every connection is asked whether it should end (idle, half a request, a client that
        takes no replies, a request nobody answers); the hot path sets no timers.
Rule 4: a listener that stops takes no more connections, answers 06 to what it has not begun, waits `stop_grace_s` for
        what is under way, answers 06 to the rest of it (0B to a write that has begun: nobody knows), and closes; who
        does not take that is cut off.
"""

from __future__ import annotations

import asyncio
import logging
import socket
from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING

from gateway import __version__
from gateway.clock import Clock
from gateway.core.budget import WATCH_S
from gateway.core.clients import Client, ClientTable
from gateway.core.log_budget import LogBudget
from gateway.core.policy import Audit
from gateway.core.ratelimit import LineLimiter
from gateway.core.site import Site
from gateway.core.stats import ModbusServerStats, TlsStats
from gateway.core.status_registers import StatusRegisters
from gateway.errors import ListenError, TlsFilesError
from gateway.faces.binding import bind_problem, listening_socket
from gateway.faces.modbus.accepting import Acceptor
from gateway.faces.modbus.admission import decide, rate_of
from gateway.faces.modbus.connection import Connection
from gateway.faces.modbus.dispatch import Dispatcher, Routes, Shared
from gateway.faces.modbus.settings import ModbusSettings, TlsSettings
from gateway.faces.modbus.sockets import Hub, SocketTransport
from gateway.faces.modbus.tcp import allowed
from gateway.faces.modbus.writer import Writer

if TYPE_CHECKING:  # 9 MiB that only sites with TLS pay
    from gateway.faces.modbus.tls import TlsDoor
    from gateway.faces.modbus.tls_files import Credentials

logger = logging.getLogger(__name__)

SEND_BUFFER = 64 * 1024
"""Octets on the way to a client: 250 of the longest replies."""


class Listener:
    """One listening address and the connections that came through it; with a `door`, through TLS."""

    def __init__(
        self,
        server: ModbusServer,
        dispatcher: Dispatcher,
        host: str,
        port: int,
        *,
        line: str = "",
        door: TlsDoor | None = None,
    ) -> None:
        self._server = server
        self._dispatcher = dispatcher
        self._door = door
        self._host = host
        self._port = port
        self._acceptor: Acceptor | None = None
        self._connections: set[Connection] = set()
        self._empty = asyncio.Event()
        shown = f"[{host}]" if ":" in host else host
        face = "modbus" if door is None else "modbus tls"
        self.label = f"{face} {shown}:{port} line {line}" if line else f"{face} {shown}:{port}"
        self.key = (host, port, line, door)
        """Two listeners that agree in this are the same."""

    @property
    def bound(self) -> tuple[str, int] | None:
        """The address that is really listened on; None while stopped."""
        if self._acceptor is None:
            return None
        host, port = self._acceptor.sock.getsockname()[:2]
        return host, port

    async def start(self) -> None:
        """Listen; raises ListenError that names the address and why. May be tried again."""
        if self._acceptor is not None:
            return
        try:
            if self._door is not None:
                self._door.open()
            sock = await listening_socket(self._host, self._port, send_buffer=SEND_BUFFER)
        except TlsFilesError as error:
            raise ListenError(f"{self.label}: {error}") from error
        except OSError as error:
            raise ListenError(f"{self.label}: {bind_problem(error)}") from error
        self._acceptor = Acceptor(self._server.hub, sock, self.label, self._accepted)
        self._server.started(self)

    async def stop(self) -> None:
        """Take no more connections, let the open ones finish (rule 4)."""
        acceptor, self._acceptor = self._acceptor, None
        if acceptor is None:
            return
        acceptor.close()
        for connection in tuple(self._connections):
            connection.finish()
        try:
            async with asyncio.timeout(self._server.settings.stop_grace_s):
                while self._connections:
                    self._empty.clear()
                    await self._empty.wait()
        except TimeoutError:
            for connection in tuple(self._connections):
                connection.give_up()
            await asyncio.sleep(0)
            for connection in tuple(self._connections):
                connection.end("stopped")
        finally:
            self._server.stopped(self)

    def _accepted(self, sock: socket.socket, peername: object) -> None:
        server = self._server
        connection = Connection(self._dispatcher, server.settings, partial(server.admit, self), self.left)
        protocol = connection if self._door is None else self._door.session(connection)
        SocketTransport(server.hub, sock, peername, protocol)

    def joined(self, connection: Connection) -> None:
        """A connection was let in."""
        self._connections.add(connection)

    def left(self, connection: Connection) -> None:
        """A connection is over."""
        self._connections.discard(connection)
        self._server.left(connection)
        if not self._connections:
            self._empty.set()


class ModbusServer:
    """The face: `listeners` are started and stopped by the service."""

    def __init__(self, settings: ModbusSettings, site: Site, clock: Clock, stats: ModbusServerStats) -> None:
        self.settings = settings
        self.hub = Hub()
        self.stats = stats
        self.clients = ClientTable(stats, settings.rate.burst_s)
        self.writer: Writer | None = None
        self.door: TlsDoor | None = None
        self.listeners: Sequence[Listener] = ()
        self._clock = clock
        self._now = clock.monotonic
        self._audit = Audit(stats.refused)
        self._connections: set[Connection] = set()
        self._listening: set[Listener] = set()
        self._sweep: asyncio.TimerHandle | None = None
        self._refusals_told = LogBudget()
        self._ends_told = LogBudget()
        self._started_at = clock.monotonic()
        self._shared = self._share(settings, site)
        self.dispatcher = Dispatcher({}, clock, self._shared)
        self._barred = Dispatcher({}, clock, self._shared, barred=True)
        self._of_line: Mapping[str, Dispatcher] = {}
        self._routes: Routes | None = None
        self._route(settings, site)
        if settings.tls is not None:
            self.door = self._new_door(settings.tls)
        self.listeners = self._listeners()

    def adjust(self, settings: ModbusSettings, site: Site, credentials: Credentials | None) -> None:
        """Go on by other settings, for another site; `credentials` are what the files of its TLS hold.

        `listeners` are those that are wanted then: the same ones where address and kind are the same. Connections
        stay, but those of clients that may not connect any more.
        """
        now = self._now()
        before, self.settings = self.settings, settings
        self._shared = self._share(settings, site)
        self._route(settings, site)
        if settings.rate != before.rate:
            self.clients.limit(lambda name: rate_of(name, settings.rate), settings.rate.burst_s, now)
        if settings.tls is None:
            self.door, self.stats.tls = None, None
        else:
            self.door = self.door or self._new_door(settings.tls)
            if credentials is not None:
                self.door.adjust(settings.tls, credentials)
        self.listeners = self._listeners()
        for connection in tuple(self._connections):
            connection.adjust(settings)
            if not allowed(connection.peer, settings.allow):
                logger.info("event=connection_ended peer=%s reason=not_allowed", connection.peer)
                connection.end("not_allowed")

    def files_unusable(self, problem: str) -> None:
        """Say that the certificate files on disk are of no use; those that were read before stay in use."""
        if self.door is not None:
            self.door.keep(problem)

    def _share(self, settings: ModbusSettings, site: Site) -> Shared:
        """What all ways in have in common; the writer goes on where there is one."""
        limiter = LineLimiter(settings.rate.lines, settings.rate.burst_s, site.devices)
        if settings.writes is None:
            if self.writer is not None:
                self.writer.refuse_waiting()
                self.writer.stop()
            self.writer = None
        elif self.writer is not None:
            self.writer.adjust(settings.writes, site)
        else:
            self.writer = Writer(settings.writes, site, self._clock, self.stats, self._audit)
            if self._listening:
                self.writer.start()
        return Shared(self.stats, self._audit, limiter, self.writer)

    def _route(self, settings: ModbusSettings, site: Site) -> None:
        self._routes = routes = Routes(settings, site, self._routes)
        own = None
        if settings.status_unit:
            own = StatusRegisters(site, self.stats, started_at=self._started_at, version=__version__)
        self.dispatcher.reroute(routes.by_unit(), self._shared, own)
        self._barred.reroute({}, self._shared)
        names = {group.line for group in settings.lines}
        known = self._of_line
        self._of_line = {name: known.get(name) or Dispatcher({}, self._clock, self._shared) for name in names}
        for name, dispatcher in self._of_line.items():
            dispatcher.reroute(routes.of_line(name), self._shared)

    def _new_door(self, settings: TlsSettings) -> TlsDoor:
        from gateway.faces.modbus.tls import TlsDoor  # noqa: PLC0415 - as said above

        self.stats.tls = TlsStats()
        timeout_s = self.settings.frame_timeout_s
        return TlsDoor(settings, self._barred, self._clock, self.stats.tls, frame_timeout_s=timeout_s)

    def _listeners(self) -> tuple[Listener, ...]:
        """The listeners of the settings; those that there are already are taken."""
        settings, door = self.settings, self.door
        wanted: list[tuple[Dispatcher, str, int, str, TlsDoor | None]]
        wanted = [(self.dispatcher, host, port, "", None) for host, port in settings.listen]
        for group in settings.lines:
            if group.tls and door is None:
                raise ValueError("a listener with TLS needs the settings of TLS")  # never open to all instead
            line_door = door if group.tls else None
            wanted += [(self._of_line[group.line], host, port, group.line, line_door) for host, port in group.listen]
        for host, port in () if settings.tls is None else settings.tls.listen:
            wanted.append((self.dispatcher, host, port, "", door))
        present = {listener.key: listener for listener in self.listeners}
        listeners = []
        for dispatcher, host, port, line, its_door in wanted:
            listener = Listener(self, dispatcher, host, port, line=line, door=its_door)
            listeners.append(present.get(listener.key, listener))
        return tuple(listeners)

    def admit(self, listener: Listener, connection: Connection, peer: str) -> Client | None:
        """Whose connection this is, when it may stay (rules 1 and 2)."""
        now = self._now()
        self.stats.connections += 1
        verdict = decide(self._connections, peer, self.settings, now)
        if verdict.leaves is not None:
            verdict.leaves.end("evicted")
            self.left(verdict.leaves)
        if verdict.refused is not None:
            self._refuse(verdict.refused, peer)
            return None
        self._connections.add(connection)
        self.stats.open_connections = len(self._connections)
        listener.joined(connection)
        return self.clients.arrived(peer, rate_of(peer, self.settings.rate), now)

    def left(self, connection: Connection) -> None:
        """A connection is over."""
        if connection not in self._connections:
            return
        self._connections.discard(connection)
        self.stats.open_connections = len(self._connections)
        self.clients.left(connection.client, connection.seen)

    def started(self, listener: Listener) -> None:
        """A listener listens."""
        if self.writer is not None and not self._listening:
            self.writer.start()
        self._listening.add(listener)
        if self._sweep is None:
            self._sweep = asyncio.get_running_loop().call_later(WATCH_S, self._sweep_again)

    def stopped(self, listener: Listener) -> None:
        """A listener is closed."""
        self._listening.discard(listener)
        if self.writer is not None and not self._listening:
            self.writer.stop()
        if not self._listening and self._sweep is not None:
            self._sweep.cancel()
            self._sweep = None

    def sweep(self) -> None:
        """End the connections whose time is up (rule 3)."""
        now = self._now()
        self.clients.settle()
        for connection in tuple(self._connections):
            connection.client.last_seen = max(connection.client.last_seen, connection.seen)
            reason = connection.overdue(now)
            if reason is not None:
                left_out = self._ends_told.spend((reason, connection.peer), now)
                if left_out is not None:
                    text = "event=connection_ended peer=%s reason=%s left_out=%d"
                    logger.info(text, connection.peer, reason, left_out)
                connection.end(reason)

    def _sweep_again(self) -> None:
        self._sweep = asyncio.get_running_loop().call_later(WATCH_S, self._sweep_again)
        self.sweep()

    def _refuse(self, reason: str, peer: str) -> None:
        self.stats.refused_connections += 1
        self.stats.closed[reason] += 1
        left_out = self._refusals_told.spend((reason, peer), self._now())
        if left_out is not None:
            logger.warning("event=connection_refused peer=%s reason=%s left_out=%d", peer, reason, left_out)
