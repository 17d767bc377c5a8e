"""The asyncio shell of one Modbus TCP upstream.

It makes no decision about requests: it keeps a connection, moves bytes and time between it and the `UpstreamEngine`,
and connects again when it ended.

Rule 1: nothing here blocks the loop: names are looked up in a thread, one lookup at a time.
Rule 2: a connection that ends is followed by the next at once, whatever ended it, so that a server that closes after
        every reply is ready for the next request one handshake later. Only one that the server closed within a second,
        before anything was asked on it, is followed after a pause.
Rule 3: the line is open until no connection could be had for `GRACE_S`: until then requests wait, and devices stay as
        they are. After that it is down, what waited has ended, and the pauses between tries grow from 0.1 to 4.5 s.
Rule 4: a server that answers no request of any controller (modbus/tcp.py) is down too, although it lets us connect.
        Whether the line is up is said when the first reply has come.
Rule 5: a name is looked up again whenever the line is down, and not while it is open.
Rule 6: a connection that is of no use any more is reset, not drained: none is ever half open. A peer that is gone
        without a word is noticed by the time-out of a request, or by keep-alive after a dozen seconds.
Rule 7: one log line when the line goes down or cannot be opened for another reason than before, one when it is up,
        and at most one a minute for each reason why a connection was dropped.
"""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import logging
import os
import socket
from collections.abc import Sequence
from functools import partial
from random import Random
from typing import cast

from gateway.clock import Clock
from gateway.core.budget import GRACE_S
from gateway.core.settings import LineSettings
from gateway.core.site import Device
from gateway.core.upstream import UpstreamEngine
from gateway.errors import PortError
from gateway.lines.ports import KEEPALIVE
from gateway.lines.shell import STABLE_S, LineShell
from gateway.lines.threads import in_thread

log = logging.getLogger(__name__)

FIRST_RETRY_S = 0.1
LAST_RETRY_S = 4.5
GRACE_RETRY_S = 0.02
AT_ONCE_S = 1.0
"""A connection that the server closes sooner, without having been asked anything, is no connection."""
SAY_AGAIN_S = 60.0
EARLY_S = 0.0005
"""A timer that goes off so much too early is not set anew."""

_Address = tuple[int, tuple[str, int] | tuple[str, int, int, int]]


class UpstreamLine(LineShell):
    """One upstream: satisfies `core.site.LinePort`."""

    def __init__(
        self, settings: LineSettings, devices: Sequence[Device], clock: Clock, rng: Random | None = None
    ) -> None:
        assert settings.upstream is not None, "a serial line has a SerialLine"
        self._rng = rng if rng is not None else Random()  # noqa: S311  # jitter, not secrets
        self._up = UpstreamEngine(settings, devices, clock.monotonic(), self._rng)
        super().__init__(self._up, devices, clock)
        self._where = settings.upstream
        self._loop: asyncio.AbstractEventLoop | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._deadline = 0.0  # what the timer is for, or sooner
        self._acted_at = 0.0
        self._connection: _Connection | None = None
        self._lookup: asyncio.Future[list[_Address]] | None = None
        self._addresses: list[_Address] = []
        self._open = False
        self._opened_at = 0.0
        self._lost_at = 0.0  # when a connection that was of use ended
        self._unheard_of = True  # no reply since the line was opened
        self._announcing: asyncio.TimerHandle | None = None
        self._said_at: dict[str, float] = {}

    def overdue_s(self, now: float) -> float:
        """How long the engine has had something to do and was not let; 0 while there is no connection."""
        if self._connection is None or self._engine.next_deadline(now) is None:
            return 0.0
        return max(0.0, now - max(self._deadline, self._acted_at))

    async def run(self) -> None:
        """Own the upstream until cancelled."""
        self._loop = asyncio.get_running_loop()
        retry_s = FIRST_RETRY_S
        try:
            while True:
                try:
                    connection = await self._connect()
                except PortError as error:
                    self._up.upstream.refused += 1
                    if self._open and self._grace_s() > 0:
                        await asyncio.sleep(GRACE_RETRY_S)
                        continue
                    self._close(str(error))
                    self._complain(str(error))
                else:
                    of_use = await self._serve(connection)
                    problem = "the server does not answer" if self._up.silent else ""
                    if of_use and not problem:
                        retry_s = FIRST_RETRY_S
                        continue
                    if not of_use and self._grace_s() <= 0:
                        problem = "the server closes connections at once"
                    if problem:
                        self._close(problem)
                        self._complain(problem)
                await asyncio.sleep(retry_s * (1 - 0.1 * self._rng.random()))
                retry_s = min(2 * retry_s, LAST_RETRY_S)
        finally:
            self._close("stopped")

    def on_bytes(self, connection: _Connection, data: bytes) -> None:
        """Bytes came."""
        if connection is self._connection:
            self._advance(data)

    def on_end(self, connection: _Connection) -> None:
        """The other end closed or reset it."""
        if connection is self._connection:
            self._end(remote=True)
            self._advance()

    def _grace_s(self) -> float:
        """How long the line stays open without a connection."""
        return self._lost_at + GRACE_S - self._clock.monotonic()

    async def _connect(self) -> _Connection:
        """A connection; PortError when there is none to be had, at the latest after `connect_timeout_s`."""
        limit_s = self._where.connect_timeout_s
        if self._open:
            limit_s = max(GRACE_RETRY_S, min(limit_s, self._grace_s()))
        try:
            async with asyncio.timeout(limit_s):
                return await self._try_addresses()
        except TimeoutError:
            raise PortError(f"no answer to the connection attempt within {limit_s:.3g} s") from None

    async def _try_addresses(self) -> _Connection:
        if not self._open or not self._addresses:
            self._addresses = await self._resolve()
        problem: OSError | None = None
        for family, address in self._addresses:
            try:
                return await self._connect_to(family, address)
            except OSError as error:
                problem = error
        assert problem is not None, "a name that was found has an address"
        reason = str(problem) if problem.errno is None else os.strerror(problem.errno).lower()
        raise PortError(reason) from problem

    async def _connect_to(self, family: int, address: tuple[object, ...]) -> _Connection:
        loop = asyncio.get_running_loop()
        sock = socket.socket(family, socket.SOCK_STREAM | socket.SOCK_NONBLOCK)
        try:
            for option, (level, value) in KEEPALIVE.items():
                with contextlib.suppress(OSError):
                    sock.setsockopt(level, option, value)
            await loop.sock_connect(sock, address)
            _, connection = await loop.create_connection(partial(_Connection, self), sock=sock)
        except BaseException:
            sock.close()
            raise
        return connection

    async def _resolve(self) -> list[_Address]:
        host, port = self._where.host, self._where.port
        with contextlib.suppress(ValueError):
            ip = ipaddress.ip_address(host)
            if ip.version == 4:
                return [(socket.AF_INET, (host, port))]
            if ip.scope_id is None:
                return [(socket.AF_INET6, (host, port, 0, 0))]
        if self._lookup is None:  # one that took longer than its try had is waited for by the next
            self._lookup = in_thread(partial(_look_up, host, port), late=lambda _: None, name=f"look-up-{self.name}")
            self._lookup.add_done_callback(lambda done: done.cancelled() or done.exception())  # nobody may wait then
        try:
            await asyncio.wait({self._lookup})
            lookup, self._lookup = self._lookup, None
            return lookup.result()
        except OSError as error:
            raise PortError(f"{host} is not known ({error.strerror or error})") from error

    async def _serve(self, connection: _Connection) -> bool:
        """Use a connection until it ends; False when it was of no use (rule 2)."""
        began = self._clock.monotonic()
        asked = self.stats.sent
        self._connection = connection
        if self._open:
            self._up.connected(began)
        else:
            self._open = True
            self._unheard_of = True
            self._opened_at = began
            self._up.opened(began)
        if connection.ended.done():
            self._end(remote=True)
        self._advance()
        await connection.ended
        if connection.error is not None:
            raise connection.error
        ended = self._clock.monotonic()
        if self.stats.sent == asked and ended - began < AT_ONCE_S:
            return False
        self._lost_at = ended
        return True

    def _end(self, *, remote: bool) -> None:
        """The connection is over, by the other end or because the engine will have no more of it."""
        connection = self._connection
        if connection is None:
            return
        now = self._clock.monotonic()
        if not remote and self._up.drop:
            self._say_dropped(self._up.drop, now)
        self._connection = None
        connection.end()
        self._up.lost(now, remote=remote)

    def _close(self, reason: str) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        if self._announcing is not None:
            self._announcing.cancel()
            self._announcing = None
        if self._connection is not None:
            self._connection.end()
            self._connection = None
        now = self._clock.monotonic()
        if self._open:
            self._flapping = now - self._opened_at < STABLE_S
        self._open = False
        self._addresses = []
        self._engine.closed(f"{self.port}: {reason}", now)
        self._engine.step(now)  # hands out what ended with the line
        self._rest()

    def _advance(self, data: bytes = b"") -> None:
        """Let the engine act; its mistake ends `run`, which the service starts again, instead of hanging the line."""
        try:
            self._act(data)
        except Exception as error:
            connection = self._connection
            if connection is None:
                raise
            connection.error = error
            connection.end()

    def _act(self, data: bytes) -> None:
        """Pass on bytes and time, write what the engine says, set the alarm for its next deadline."""
        engine = self._up
        self._acted_at = now = self._clock.monotonic()
        if data:
            replies = self.stats.ok
            engine.receive(data, now)
            if self._unheard_of and self.stats.ok > replies:
                self._heard()
        engine.on_timer(now)
        if engine.drop is not None:
            self._end(remote=False)
        frames = []
        while (frame := engine.step(now)) is not None:
            frames.append(frame)
        if frames and self._connection is not None:
            self._connection.write(b"".join(frames))
        self._set_alarm(engine.next_deadline(now), now)
        self._rest()

    def _heard(self) -> None:
        """The first reply since the line was opened."""
        self._unheard_of = False
        if self._loop is not None:
            self._announcing = self._loop.call_later(STABLE_S if self._flapping else 0.0, self._announce)

    def _set_alarm(self, deadline: float | None, now: float) -> None:
        if deadline is None or self._loop is None:
            return
        if self._timer is not None:
            if self._deadline <= deadline + EARLY_S:
                return  # it looks again when it goes off
            self._timer.cancel()
        self._deadline = deadline
        self._timer = self._loop.call_later(max(0.0, deadline - now), self._on_timer)

    def _on_timer(self) -> None:
        self._timer = None
        self._advance()

    def _say_dropped(self, reason: str, now: float) -> None:
        said_at = self._said_at.get(reason)
        if said_at is None or now - said_at >= SAY_AGAIN_S:
            self._said_at[reason] = now
            log.warning('event=upstream_dropped line=%s port="%s" reason=%s', self.name, self.port, reason)


class _Connection(asyncio.Protocol):
    """A connection and its end."""

    def __init__(self, line: UpstreamLine) -> None:
        self._line = line
        self._transport: asyncio.Transport | None = None
        self.ended: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self.error: Exception | None = None  # a bug that ended it

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast("asyncio.Transport", transport)  # uvloop's is none by its class

    def data_received(self, data: bytes) -> None:
        self._line.on_bytes(self, data)

    def eof_received(self) -> None:
        self._line.on_end(self)
        self.end()

    def connection_lost(self, exc: Exception | None) -> None:
        del exc
        self._line.on_end(self)
        self.end()

    def write(self, data: bytes) -> None:
        """Send requests; there are never more of them than the window allows."""
        if self._transport is not None:
            self._transport.write(data)

    def end(self) -> None:
        """Nothing is sent or taken any more."""
        if self._transport is not None:
            self._transport.abort()
            self._transport = None
        if not self.ended.done():
            self.ended.set_result(None)


def _look_up(host: str, port: int) -> list[_Address]:
    """All addresses of a name; blocks. OSError when it has none."""
    found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
    return [(int(family), address) for family, _, _, _, address in found]  # type: ignore[misc]  # of IPv4 and IPv6 only
