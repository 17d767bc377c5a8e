"""A connection of the HTTP face: one request after another, each answered before the next is looked at.

Rule 1: who sends no whole head within `idle_timeout_s`, or no further request, is closed; so is who does not take a
        reply to the end within `send_timeout_s`.
Rule 2: at most `max_connections` are kept. When one more comes, the one that has been open longest and has no request
        under way makes room. Where all have one, as many more are let in three times over; then, of those whose clients
        do not take their replies, the one that has been open longest makes room; where there is none, the newcomer.
Rule 3: while a request is under way nothing more is read than one further head. A head that comes in pieces is looked
        at when its end has come, and else not before it is twice as long as it was.
Rule 4: a handler that fails costs its own connection: 500, counted and logged.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import socket
import struct
from typing import cast

from gateway.clock import Clock
from gateway.faces.http.own import HttpStats
from gateway.faces.http.request import Handler, Reply, Request
from gateway.faces.http.settings import HttpSettings
from gateway.faces.http.wire import HEAD_BYTES, LAST_CHUNK, Fields, Head, Refusal, chunk, ends, reply_head, take

BUSY_FACTOR = 4
"""So many times `max_connections` there can be while each of them has a request under way."""

_AT_ONCE = struct.pack("ii", 1, 0)
"""What is under way ends by a reset: nobody takes a part for the whole, and the kernel keeps nothing of it."""

_log = logging.getLogger(__name__)


class Connections:
    """All connections of one listener; called, it makes the next."""

    def __init__(self, settings: HttpSettings, handler: Handler, clock: Clock, stats: HttpStats) -> None:
        self.settings = settings
        self.handler = handler
        self.clock = clock
        self.stats = stats
        self._live: dict[Connection, None] = {}  # the oldest first
        self._empty: asyncio.Event | None = None  # while it closes

    def __call__(self) -> Connection:
        """One more, not connected yet."""
        return Connection(self)

    def entered(self, connection: Connection) -> None:
        """It is connected: rule 2."""
        # One that closes and waits for its peer still takes a place: only being aborted frees it.
        staying = [other for other in self._live if not other.aborted]
        surplus = len(staying) + 1 - self.settings.max_connections
        for other in staying if surplus > 0 else ():
            if not other.busy:
                other.abort()
                self.stats.closed_for_room += 1
                surplus -= 1
                if surplus == 0:
                    break
        if len(self._live) >= BUSY_FACTOR * self.settings.max_connections:
            stalled = (other for other in staying if other.stalled and not other.aborted)
            next(stalled, connection).abort()
            self.stats.closed_for_room += 1
        self._live[connection] = None

    def left(self, connection: Connection) -> None:
        """It is not connected any more."""
        self._live.pop(connection, None)
        if not self._live and self._empty is not None:
            self._empty.set()

    async def close(self) -> None:
        """Close all; replies under way have `stop_grace_s`."""
        self._empty = asyncio.Event()
        for connection in tuple(self._live):
            connection.finish()
        if self._live:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(self.settings.stop_grace_s):
                    await self._empty.wait()
        for connection in tuple(self._live):
            connection.abort()


class Connection(asyncio.Protocol):
    """One connection; its own `Exchange` for the request under way."""

    def __init__(self, among: Connections) -> None:
        self._among = among
        self._transport: asyncio.Transport | None = None
        self.aborted = False  # it ends in a later turn of the loop
        self._buffer = bytearray()
        self._enough = 0  # bytes in it with which it is looked at though no head ends there
        self._timer: asyncio.TimerHandle | None = None
        self._task: asyncio.Task[None] | None = None  # the request under way
        self._room: asyncio.Future[None] | None = None  # somebody waits until more can be sent
        self._full = False
        self._last = False  # no request after this one
        self._begun = False  # a reply's head is sent
        self._chunked = False
        self._head_only = False

    @property
    def busy(self) -> bool:
        """Whether a request is under way."""
        return self._task is not None

    @property
    def stalled(self) -> bool:
        """Whether its client has not taken what was sent."""
        return self._full

    @property
    def local(self) -> tuple[str, int]:
        """See `Exchange.local`."""
        name = self._extra("sockname")
        return (str(name[0]), int(name[1])) if isinstance(name, tuple) else ("", 0)

    @property
    def peer(self) -> str:
        """See `Exchange.peer`."""
        name = self._extra("peername")
        return str(name[0]) if isinstance(name, tuple) else ""

    @property
    def secure(self) -> bool:
        """See `Exchange.secure`."""
        return self._extra("sslcontext") is not None

    def _extra(self, name: str) -> object:
        return None if self._transport is None else self._transport.get_extra_info(name)

    # What the loop calls.

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """See `asyncio.Protocol`."""
        self._transport = cast("asyncio.Transport", transport)  # uvloop's are no subclasses
        self._wait()
        self._among.entered(self)

    def data_received(self, data: bytes) -> None:
        """See `asyncio.Protocol`."""
        self._buffer += data
        if self._task is None:
            if len(self._buffer) >= self._enough or ends(self._buffer, len(data)):
                self._next()
        elif len(self._buffer) >= HEAD_BYTES and self._transport is not None:  # rule 3
            self._transport.pause_reading()

    def eof_received(self) -> bool:
        """See `asyncio.Protocol`: who has said all still gets the reply that is under way; not so by TLS."""
        self._last = True
        return self._task is not None and not self.secure

    def connection_lost(self, exc: Exception | None) -> None:
        """See `asyncio.Protocol`."""
        del exc
        self._transport = None
        self._stop_timer()
        self._among.left(self)
        if self._room is not None and not self._room.done():
            self._room.cancel()
        if self._task is not None:
            self._task.cancel()

    def pause_writing(self) -> None:
        """See `asyncio.Protocol`."""
        self._full = True

    def resume_writing(self) -> None:
        """See `asyncio.Protocol`."""
        self._full = False
        if self._room is not None and not self._room.done():
            self._room.set_result(None)

    # What `Connections` calls.

    def finish(self) -> None:
        """Close, or let the request under way be the last."""
        self._last = True
        if self._task is None:
            self._close()

    def abort(self) -> None:
        """See `Exchange.abort`."""
        self.aborted = True
        if self._transport is not None:
            sock = self._extra("socket")
            if sock is not None and (self.busy or self._transport.get_write_buffer_size()):
                with contextlib.suppress(OSError):  # it is gone already
                    cast("socket.socket", sock).setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _AT_ONCE)
            self._transport.abort()

    # What a handler calls.

    def begin(self, fields: Fields) -> None:
        """See `Exchange.begin`."""
        framing = (("Transfer-Encoding", "chunked"),) if self._chunked else ()
        self._last = self._last or not self._chunked
        self._send_head(200, (*fields, *framing))

    async def write(self, data: bytes) -> None:
        """See `Exchange.write`."""
        if data and not self._head_only:
            self._send(chunk(data) if self._chunked else data)
            await self._drained()

    async def end(self) -> None:
        """See `Exchange.end`."""
        if self._chunked and not self._head_only:
            self._send(LAST_CHUNK)
        await self._drained()

    # One request after another.

    def _next(self) -> None:
        """Begin the next request, if it is there."""
        found = take(self._buffer)
        self._enough = min(2 * len(self._buffer), HEAD_BYTES)
        if found is None or self._transport is None:
            return
        self._stop_timer()
        if isinstance(found, Refusal):
            self._last, self._head_only = True, False
            self._buffer.clear()
            self._answer(Reply(found.status, f"{found.text}\n".encode()))
            self._close()
            return
        self._last = self._last or not found.keep_alive
        self._begun, self._chunked, self._head_only = False, found.chunked, found.method == "HEAD"
        self._task = asyncio.get_running_loop().create_task(self._serve(found))
        self._task.add_done_callback(self._served)

    async def _serve(self, head: Head) -> None:
        try:
            reply = await self._among.handler(Request(head, self))
            if reply is not None:
                self._answer(reply)
                async with asyncio.timeout(self._among.settings.send_timeout_s):
                    await self._drained()
        except TimeoutError:
            self.abort()
        except Exception:  # noqa: BLE001 - the connection's edge: counted and logged here
            self._last = True
            self._among.stats.failed += 1
            _log.exception("event=http_request_failed path=%s", json.dumps(head.path[:80]))
            if self._begun:
                self.abort()
            else:
                self._answer(Reply(500, b"this is a mistake of the gateway, and in its log\n"))

    def _served(self, task: asyncio.Task[None]) -> None:
        self._task = None
        if self._transport is None or self._transport.is_closing():
            return
        if task.cancelled():
            self.abort()
        elif self._last:
            self._close()
        else:
            self._wait()
            self._transport.resume_reading()
            self._next()

    def _answer(self, reply: Reply) -> None:
        length = (("Content-Type", reply.content_type), ("Content-Length", str(len(reply.body))))
        self._send_head(reply.status, (*length, *reply.fields))
        if not self._head_only:
            self._send(reply.body)

    def _send_head(self, status: int, fields: Fields) -> None:
        self._begun = True
        self._send(reply_head(status, fields, self._among.clock.wall(), keep_alive=not self._last))

    def _send(self, data: bytes) -> None:
        if self._transport is None or self._transport.is_closing():
            raise asyncio.CancelledError  # nobody is there any more
        self._transport.write(data)

    async def _drained(self) -> None:
        if self._full:
            self._room = asyncio.get_running_loop().create_future()
            await self._room

    # Time.

    def _wait(self) -> None:
        """Rule 1, for the next head."""
        self._set_timer(self._among.settings.idle_timeout_s)

    def _close(self) -> None:
        """Close when everything is sent; rule 1, for the end of a reply."""
        self._set_timer(self._among.settings.send_timeout_s)
        if self._transport is not None:
            self._transport.close()

    def _set_timer(self, after_s: float) -> None:
        self._stop_timer()
        if self._transport is not None:
            self._timer = asyncio.get_running_loop().call_later(after_s, self.abort)

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
