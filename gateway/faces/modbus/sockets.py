"""Plain TCP for many small requests: the face's sockets behind one epoll, which is all that the event loop watches.

A loop's own transport costs more than the work on a request that is answered from memory. Here a turn of the loop
serves every client that is ready, with one read and one write each; the protocols see what asyncio promises them.

Rule 1: a transport calls its protocol as asyncio's do: `connection_made`, any `data_received`, at most one
        `eof_received`, `pause_writing` and `resume_writing` in turn, `connection_lost` exactly once, last, and
        never from within a call of the protocol's own.
Rule 2: what is written goes to the kernel at once. The rest is kept in order; more than the protocol's limit of
        it pauses the protocol.
Rule 3: nobody has the loop for long: a turn serves `TURN` events, and takes 2.5 kB from each socket. Others that have
        it for longer than a request takes let a turn come between (`serve`).
Rule 4: a peer that is gone is noticed also while nothing is read from it.
Rule 5: a client's socket is watched for edges: the kernel tells once that something came, and does not look again
        whether more is there, which is a tenth of the work on a small request. So whoever takes less than all
        that may be there says so with `change`, and is told again. A read that got less than it asked for has
        taken all, but for the end of the stream, which the kernel tells of as well (`EPOLLRDHUP`).
"""

from __future__ import annotations

import asyncio
import os
import select
import socket
import struct
from collections.abc import Callable
from contextlib import suppress
from typing import Any

TURN = 128
FIRST_BYTES = 448
"""What Python's own allocator has room for, which is quicker; 37 requests, and mostly there is one."""

READ_BYTES = 2048

READING = select.EPOLLIN | select.EPOLLRDHUP | select.EPOLLET
"""What is waited for while a client's bytes are taken (rule 5)."""

_IN = select.EPOLLIN
_MORE_TO_COME = select.EPOLLRDHUP | select.EPOLLHUP | select.EPOLLERR
_NOTHING = select.EPOLLET
_read = os.read
_write = os.write


class Hub:
    """The epoll of one face. It belongs to the loop that runs when the first descriptor is added."""

    def __init__(self) -> None:
        self._epoll: select.epoll | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._calls: dict[int, Callable[[int], None]] = {}
        self._takers: dict[int, Callable[[bytes], None]] = {}

    def add(self, fd: int, events: int, call: Callable[[int], None], take: Callable[[bytes], None] | None) -> None:
        """Have `call` called with what has happened whenever `events` have; errors are told in any case.

        With `take`, bytes that can be read are read and given to it, and `call` hears of all else.
        """
        if self._epoll is None:
            self._epoll = select.epoll()
            self._loop = asyncio.get_running_loop()
            self._loop.add_reader(self._epoll.fileno(), self.serve)
        self._epoll.register(fd, events)
        self._calls[fd] = call
        if take is not None:
            self._takers[fd] = take

    def change(self, fd: int, events: int) -> None:
        """Wait for these events; those that are there already are told of once more."""
        if self._epoll is not None:
            self._epoll.modify(fd, events)

    def remove(self, fd: int) -> None:
        """Forget a descriptor, before it is closed."""
        self._takers.pop(fd, None)
        if self._calls.pop(fd, None) is None or self._epoll is None or self._loop is None:
            return
        self._epoll.unregister(fd)
        if not self._calls:
            self._loop.remove_reader(self._epoll.fileno())
            self._epoll.close()
            self._epoll = self._loop = None

    def serve(self) -> None:
        """One turn: serve who is ready. The loop calls it, and whoever else has the loop and gives way.

        It costs a microsecond when nobody is ready.
        """
        if self._epoll is None:
            return
        poll = self._epoll.poll
        left = TURN
        while left > 0 and self._epoll is not None:
            ready = poll(0, left)
            if not ready:
                return
            left -= len(ready)
            try:
                self._serve(ready)
            except BaseException:
                for fd in {fd for fd, _ in ready} & self._takers.keys():  # told once: those after it must hear again
                    self.change(fd, READING)
                raise

    def _serve(self, ready: list[tuple[int, int]]) -> None:
        takers = self._takers
        for fd, events in ready:
            if events == _IN and (take := takers.get(fd)) is not None:
                data = b""
                try:
                    data = _read(fd, FIRST_BYTES)
                    if len(data) == FIRST_BYTES:
                        self.change(fd, READING)
                        data += _read(fd, READ_BYTES)
                except OSError:
                    pass  # nothing more, or the next read meets it again
                if data:
                    take(data)
                    continue
            call = self._calls.get(fd)
            if call is not None:  # None: closed by what another one did in this turn
                call(events)


_AT_ONCE = struct.pack("ii", 1, 0)
"""A reset, and not an orderly end behind all that was sent."""

_NOBODY = asyncio.Protocol()
"""Whom a transport that ended tells nothing."""


class SocketTransport(asyncio.Transport):
    """One client's socket."""

    def __init__(self, hub: Hub, sock: socket.socket, peername: object, protocol: asyncio.Protocol) -> None:
        super().__init__({"socket": sock, "peername": peername})
        self._hub = hub
        self._sock = sock
        self._fd = sock.fileno()
        self._protocol = protocol
        self._events = READING
        self._rest = bytearray()  # written, and not yet taken by the kernel
        self._high = 65536
        self._paused = False  # the protocol was told to write no more
        self._reading = True
        self._ended = False  # the peer sends no more
        self._closing = False
        self._lost = False
        self._free = True  # nothing is in the way of what is written next
        hub.add(self._fd, self._events, self._event, protocol.data_received)
        protocol.connection_made(self)

    # What the protocol calls

    def get_protocol(self) -> asyncio.BaseProtocol:
        """The protocol that it was made with."""
        return self._protocol

    def is_closing(self) -> bool:
        """Whether `close` or `abort` was called, or the connection is lost."""
        return self._closing

    def is_reading(self) -> bool:
        """Whether received bytes are taken."""
        return self._reading

    def pause_reading(self) -> None:
        """Leave what comes to the kernel."""
        self._reading = False
        self._wait()

    def resume_reading(self) -> None:
        """Take what comes again."""
        self._reading = True
        self._wait()

    def set_write_buffer_limits(self, high: int | None = None, low: int | None = None) -> None:
        """More than `high` bytes of rest pause the protocol; a quarter of it or less resume it."""
        del low
        self._high = 65536 if high is None else high

    def get_write_buffer_size(self) -> int:
        """Bytes that the kernel has not taken."""
        return len(self._rest)

    def write(self, data: bytes | bytearray | memoryview[Any]) -> None:
        """Send `data` after all that was written before (rule 2)."""
        if self._free:
            try:
                sent = _write(self._fd, data)
            except (BlockingIOError, InterruptedError):
                sent = 0
            except OSError as error:
                self._drop(error)
                return
            if sent == len(data):
                return
            self._rest += memoryview(data)[sent:]
            self._wait()
        elif self._closing:
            return
        else:
            self._rest += data
        if not self._paused and len(self._rest) > self._high:
            self._paused = True
            self._protocol.pause_writing()

    def can_write_eof(self) -> bool:
        """It ends with `close` only."""
        return False

    def close(self) -> None:
        """Take nothing more, send the rest, then end the connection."""
        if self._closing:
            return
        self._closing = True
        self._wait()
        if not self._rest:
            self._drop(None)

    def abort(self) -> None:
        """End the connection now; what the client did not take is thrown away, by the kernel as well."""
        if self._rest:
            with suppress(OSError):  # it is gone already
                self._sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _AT_ONCE)
        self._closing = True
        self._drop(None)

    # What the hub calls

    def _event(self, events: int) -> None:
        if events & select.EPOLLOUT:
            self._flush()
        if events != select.EPOLLOUT and not self._lost:
            if self._reading and not self._closing and not self._ended:
                self._receive(events)
            elif events & (select.EPOLLHUP | select.EPOLLERR):
                self._drop(None)  # rule 4

    def _receive(self, events: int) -> None:
        try:
            data = _read(self._fd, READ_BYTES)
        except (BlockingIOError, InterruptedError):
            return
        except OSError as error:
            self._drop(error)
            return
        if data:
            if len(data) == READ_BYTES or events & _MORE_TO_COME:
                self._hub.change(self._fd, self._events)
            self._protocol.data_received(data)
            return
        self._ended = True
        self._wait()
        if not self._protocol.eof_received():
            self.close()

    def _flush(self) -> None:
        if not self._rest or self._lost:
            return
        try:
            sent = _write(self._fd, self._rest)
        except (BlockingIOError, InterruptedError):
            return
        except OSError as error:
            self._drop(error)
            return
        del self._rest[:sent]
        if not self._rest:
            self._wait()
            if self._closing:
                self._drop(None)
                return
        if self._paused and len(self._rest) <= self._high // 4:
            self._paused = False
            self._protocol.resume_writing()

    def _wait(self) -> None:
        """Wait for what can be done now, and for nothing else."""
        self._free = not (self._rest or self._closing)
        if self._lost:
            return
        events = READING if self._reading and not self._closing and not self._ended else _NOTHING
        if self._rest:
            events |= select.EPOLLOUT
        if events != self._events:
            self._events = events
            self._hub.change(self._fd, events)

    def _drop(self, error: OSError | None) -> None:
        if self._lost:
            return
        self._lost = self._closing = True
        self._free = False
        self._rest.clear()
        self._hub.remove(self._fd)
        asyncio.get_running_loop().call_soon(self._end, error)

    def _end(self, error: OSError | None) -> None:
        protocol, self._protocol = self._protocol, _NOBODY  # no circle: it is freed without the collector
        try:
            protocol.connection_lost(error)
        finally:
            self._sock.close()
