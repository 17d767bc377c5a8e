"""The connections of one upstream: raw sockets behind one epoll, which is all that the event loop watches.

A server that closes after every reply wants a new connection for each request. A loop's own transport costs several
times what the kernel takes for one; here a connection is five system calls and a request on it three more.

Rule 1: nothing here waits. A connection to a machine near by is often made within the call; else the loop tells.
Rule 2: what the kernel does not take at once is kept and sent when it does; it is never more than the window allows.
Rule 3: the owner hears of a connection that is made, of bytes, and once of its end, if the other end brought it about;
        never after it ended the connection itself, and never from within a call of its own.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import os
import select
import socket
from typing import Protocol

from gateway.lines.ports import KEEPALIVE

Address = tuple[int, tuple[str, int] | tuple[str, int, int, int]]
"""Family and socket address."""

READ_BYTES = 8192
_READING = select.EPOLLIN | select.EPOLLRDHUP
_PENDING = (errno.EINPROGRESS, errno.EALREADY)
_MADE_OR_PENDING = (0, errno.EISCONN, *_PENDING)


class Owner(Protocol):
    """Whom a link tells (rule 3)."""

    def on_made(self, link: Link) -> None:
        """There is a connection now."""
        ...

    def on_bytes(self, link: Link, data: bytes) -> None:
        """Bytes came."""
        ...

    def on_end(self, link: Link, error: int) -> None:
        """The other end closed or reset it, or it could not be made: `error` says why, 0 for an end of stream."""
        ...


class Links:
    """The epoll of one upstream; it belongs to the loop that runs when it is made."""

    def __init__(self) -> None:
        self._loop = asyncio.get_running_loop()
        self._epoll = select.epoll()
        self._links: dict[int, Link] = {}
        self._loop.add_reader(self._epoll.fileno(), self._ready)

    def close(self) -> None:
        """Watch nothing any more."""
        self._loop.remove_reader(self._epoll.fileno())
        self._epoll.close()

    def add(self, link: Link, events: int) -> None:
        """Tell a link of these events; a socket that is closed is forgotten by the kernel."""
        self._epoll.register(link.fd, events)
        self._links[link.fd] = link

    def change(self, link: Link, events: int) -> None:
        """Tell it of these instead."""
        self._epoll.modify(link.fd, events)

    def forget(self, link: Link) -> None:
        """It is about to be closed."""
        self._links.pop(link.fd, None)

    def _ready(self) -> None:
        for fd, events in self._epoll.poll(0):
            link = self._links.get(fd)
            if link is not None:  # None: ended by what came of another
                link.on_events(events)


class Link:
    """One connection, with its number among those of its upstream.

    `made` tells whether there is a connection yet. OSError when it is known at once that there will be none.
    """

    __slots__ = ("_lasting", "_links", "_owner", "_rest", "_sock", "_where", "asked", "began", "fd", "made", "number")

    def __init__(self, owner: Owner, links: Links, number: int, address: Address, *, lasting: bool, now: float) -> None:
        self._owner = owner
        self._links = links
        self._lasting = lasting
        self._rest = b""  # written, and not yet taken by the kernel
        self.number = number
        self.began = now
        self.asked = False  # anything was sent
        self.made = False
        family, self._where = address
        self._sock = socket.socket(family, socket.SOCK_STREAM | socket.SOCK_NONBLOCK)
        self.fd = self._sock.fileno()
        try:
            if lasting:
                self._prepare()
            self._connect()
            self.made = self._connect()  # what is done by then, or has failed, says so
            links.add(self, _READING if self.made else select.EPOLLOUT)
        except BaseException:
            self._sock.close()
            raise

    def write(self, data: bytes) -> None:
        """Send requests (rule 2)."""
        self.asked = True
        if self._rest:
            self._rest += data
            return
        sent = self._send(data)
        if sent < len(data):
            self._rest = data[sent:]
            self._links.change(self, _READING | select.EPOLLOUT)

    def close(self) -> None:
        """Nothing is sent or taken any more."""
        if self.fd >= 0:
            self._links.forget(self)
            self.fd = -1
            self._sock.close()

    def on_events(self, events: int) -> None:
        """What epoll tells."""
        if not self.made:
            self._on_made()
            return
        if events & select.EPOLLOUT and self._rest:
            self._rest = self._rest[self._send(self._rest) :]
            if not self._rest:
                self._links.change(self, _READING)
        if events & ~select.EPOLLOUT:
            self._receive()

    def _connect(self) -> bool:
        """Begin to connect, or see how far that is: whether there is a connection. OSError: there will be none."""
        error = self._sock.connect_ex(self._where)
        if error not in _MADE_OR_PENDING:
            raise OSError(error, os.strerror(error))
        return error not in _PENDING

    def _on_made(self) -> None:
        try:
            self.made = self._connect()
        except OSError as error:
            self._owner.on_end(self, error.errno or errno.EIO)
            return
        if not self.made:
            return  # what was told is of another one that had this descriptor
        self._links.change(self, _READING)
        self._owner.on_made(self)

    def _receive(self) -> None:
        while self.fd >= 0:
            try:
                data = os.read(self.fd, READ_BYTES)
            except (BlockingIOError, InterruptedError):
                return
            except OSError as error:
                self._owner.on_end(self, error.errno or errno.EIO)
                return
            if not data:
                self._owner.on_end(self, 0)
                return
            self._owner.on_bytes(self, data)
            if self._lasting:
                return  # else the end may have come meanwhile

    def _send(self, data: bytes) -> int:
        try:
            return os.write(self.fd, data)
        except OSError:
            return 0  # no room: it tells when there is; any other reason comes back with the next read

    def _prepare(self) -> None:
        """For a connection that lasts: requests that follow each other wait for nothing, and a dead peer is noticed."""
        for option, (level, value) in KEEPALIVE.items():
            with contextlib.suppress(OSError):
                self._sock.setsockopt(level, option, value)
