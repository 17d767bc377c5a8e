"""Bytes between an open port and its line, without ever blocking the loop.

Rule 1: a port with a file descriptor (a device, `socket://`) is on the event loop; one without (`rfc2217://`) has a
        thread that reads and one that writes.
Rule 2: the port is looked at when bytes are due, not at each byte: the reader sleeps until the awaited reply can be
        whole, a little early. A reply of 170 bytes costs a few wake-ups.
Rule 3: whatever goes wrong is told once, as the line's failure; after that nothing is read any more, for a dead
        descriptor is readable for ever.
Rule 4: nothing is sent late. A port that has not taken a frame when the next one is due has failed: what it was given
        ended long ago for who asked, and a write among it must not reach a controller then.
"""

from __future__ import annotations

import asyncio
import contextlib
import io
import math
import os
import queue
import threading
from collections.abc import Callable
from typing import Protocol, TypeVar

import serial

T = TypeVar("T")

READ_BYTES = 512
LONGEST_PAUSE_S = 0.25
"""How long the reader may sleep: a port that was unplugged meanwhile is noticed after that."""
LATE_S = 0.001
"""By how much asyncio's timers may be late."""
SHORTEST_PAUSE_S = 0.002
"""A shorter sleep costs more than the wake-ups it saves."""
THREAD_READ_S = 0.1
WAITING_FRAMES = 4
TAKES_NO_MORE = "the other end takes no more requests"


class Owner(Protocol):
    """What a transport tells its line, and what it asks; always on the loop."""

    def on_bytes(self, data: bytes) -> None:
        """Bytes came."""
        ...

    def on_failure(self, reason: str) -> None:
        """The port is of no use any more."""
        ...

    def bytes_due(self) -> int:
        """How many bytes of an awaited reply are at least still to come; 0 when none is awaited."""
        ...


class Transport(Protocol):
    """A port in use."""

    def start(self) -> None:
        """Begin to read."""
        ...

    def stop(self) -> None:
        """End; the port may be closed after it."""
        ...

    def write(self, frame: bytes) -> None:
        """Send a frame."""
        ...

    def take(self) -> bytes:
        """What is there already although the reader sleeps."""
        ...


def transport_for(
    port: serial.Serial, loop: asyncio.AbstractEventLoop, owner: Owner, *, char_s: float, name: str
) -> Transport:
    """The transport that suits an open port; `char_s` is the time of one character on the line."""
    try:
        fd = int(port.fileno())
    except (io.UnsupportedOperation, AttributeError, OSError):
        return ThreadTransport(port, loop, owner, name)
    return FileTransport(fd, loop, owner, char_s)


class FileTransport:
    """A port with a file descriptor, on the event loop."""

    def __init__(self, fd: int, loop: asyncio.AbstractEventLoop, owner: Owner, char_s: float) -> None:
        self._fd = fd
        self._loop = loop
        self._owner = owner
        self._char_s = char_s
        self._rest = b""
        self._got = 0  # bytes since the last frame went out
        self._total = 0  # bytes until the awaited reply can be whole, those included
        self._whole_at = math.inf  # by then they are there
        self._pause: asyncio.TimerHandle | None = None
        self._ended = False

    def start(self) -> None:
        """See `Transport.start`."""
        os.set_blocking(self._fd, False)
        self._loop.add_reader(self._fd, self._readable)

    def stop(self) -> None:
        """See `Transport.stop`."""
        self._ended = True
        if self._pause is not None:
            self._pause.cancel()
            self._pause = None
        self._loop.remove_reader(self._fd)
        self._loop.remove_writer(self._fd)

    def write(self, frame: bytes) -> None:
        """Send a frame; what the kernel does not take now follows as soon as it does, until the next frame (rule 4)."""
        if self._ended:
            return
        if self._rest:
            self._fail(TAKES_NO_MORE)
            return
        self._rest = frame
        self._writable()
        self._got = self._total = 0
        self._sleep_until(self._loop.time() + (len(frame) + self._owner.bytes_due()) * self._char_s)

    def take(self) -> bytes:
        """See `Transport.take`."""
        if self._ended or self._pause is None:
            return b""
        try:
            return os.read(self._fd, READ_BYTES)
        except OSError:  # nothing there, or the reader will find out
            return b""

    def _writable(self) -> None:
        try:
            written = os.write(self._fd, self._rest)
        except BlockingIOError:
            written = 0
        except OSError as error:
            self._fail(error.strerror or str(error))
            return
        self._rest = self._rest[written:]
        if self._rest:
            self._loop.add_writer(self._fd, self._writable)
        else:
            self._loop.remove_writer(self._fd)

    def _readable(self) -> None:
        try:
            data = os.read(self._fd, READ_BYTES)
        except BlockingIOError:
            return
        except OSError as error:
            self._fail(error.strerror or str(error))
            return
        if not data:
            self._fail("end of file (unplugged?)")
            return
        self._got += len(data)
        self._owner.on_bytes(data)
        due = self._owner.bytes_due()
        if due:
            # Adapters hand bytes over in batches, so what is missing may have arrived there long ago: each look
            # gives an upper bound for the end of the reply, the least of them holds.
            if self._got + due != self._total:
                self._total = self._got + due
                self._whole_at = math.inf
            self._whole_at = min(self._whole_at, self._loop.time() + due * self._char_s)
            self._sleep_until(self._whole_at)

    def _sleep_until(self, whole_at: float) -> None:
        pause_s = min(whole_at - self._char_s - LATE_S - self._loop.time(), LONGEST_PAUSE_S)
        if pause_s < SHORTEST_PAUSE_S or self._ended:
            return
        if self._pause is None:
            self._loop.remove_reader(self._fd)
        else:
            self._pause.cancel()
        self._pause = self._loop.call_later(pause_s, self._wake)

    def _wake(self) -> None:
        self._pause = None
        self._loop.add_reader(self._fd, self._readable)
        self._readable()

    def _fail(self, reason: str) -> None:
        self.stop()
        self._owner.on_failure(reason)


class ThreadTransport:
    """A port without a file descriptor: pyserial's `rfc2217://` keeps its socket to itself."""

    def __init__(self, port: serial.Serial, loop: asyncio.AbstractEventLoop, owner: Owner, name: str) -> None:
        self._port = port
        self._loop = loop
        self._owner = owner
        self._ended = threading.Event()
        self._frames: queue.Queue[bytes | None] = queue.Queue(WAITING_FRAMES)
        self._threads = [
            threading.Thread(target=work, name=f"{name}-{what}", daemon=True)
            for what, work in (("read", self._read), ("write", self._write))
        ]

    def start(self) -> None:
        """See `Transport.start`."""
        self._port.timeout = THREAD_READ_S
        for thread in self._threads:
            thread.start()

    def stop(self) -> None:
        """See `Transport.stop`; the threads end by themselves within `THREAD_READ_S`."""
        self._ended.set()
        with contextlib.suppress(queue.Full):
            self._frames.put_nowait(None)

    def write(self, frame: bytes) -> None:
        """Send a frame; when the network takes none any more, the port has failed."""
        try:
            self._frames.put_nowait(frame)
        except queue.Full:
            self._fail(TAKES_NO_MORE)

    def take(self) -> bytes:
        """See `Transport.take`; this reader never sleeps."""
        return b""

    def _read(self) -> None:
        try:
            while not self._ended.is_set():
                data = self._port.read(1)
                if data:
                    data += self._port.read(self._port.in_waiting)
                    self._tell(self._bytes, data)
        except Exception as error:  # noqa: BLE001  # the edge to pyserial: TypeError and AttributeError come out too
            self._tell(self._fail, str(error))

    def _write(self) -> None:
        try:
            while not self._ended.is_set():
                frame = self._frames.get()
                if frame is not None and not self._ended.is_set():
                    self._port.write(frame)
        except Exception as error:  # noqa: BLE001  # as above
            self._tell(self._fail, str(error))

    def _tell(self, what: Callable[[T], None], said: T) -> None:
        with contextlib.suppress(RuntimeError):  # the loop is closed: nobody listens
            self._loop.call_soon_threadsafe(what, said)

    def _bytes(self, data: bytes) -> None:
        if not self._ended.is_set():
            self._owner.on_bytes(data)

    def _fail(self, reason: str) -> None:
        if not self._ended.is_set():
            self.stop()
            self._owner.on_failure(reason)
