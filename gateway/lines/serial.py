"""The asyncio shell that owns one serial port.

It makes no decision: it opens the port, moves bytes and time between the port and the `LineEngine`, and
opens the port again after a failure. A device path is read through the event loop, and only when bytes
are due, so that a reply of 170 bytes costs a few wake-ups and not 170; a port without a file descriptor
(`rfc2217://`) is read by a thread.
"""

from __future__ import annotations

import asyncio
import contextlib
import io
import logging
import os
import threading
from collections.abc import Callable, Sequence
from random import Random

import serial

from gateway.clock import Clock
from gateway.core.engine import LineEngine
from gateway.core.requests import Lane
from gateway.core.settings import LineSettings
from gateway.core.site import Device, LineStatus, Outcome, Ticket
from gateway.core.stats import LineStats
from gateway.errors import PortError
from gateway.lines.ports import open_port

log = logging.getLogger(__name__)

FIRST_RETRY_S = 0.1
LAST_RETRY_S = 5.0
SETTLE_S = 0.2  # a USB adapter that was just plugged in may still spit bytes
READ_BYTES = 512


class SerialLine:
    """One serial line: satisfies `core.site.LinePort`."""

    def __init__(
        self, settings: LineSettings, devices: Sequence[Device], clock: Clock, rng: Random | None = None
    ) -> None:
        self.settings = settings
        self._clock = clock
        self._rng = rng if rng is not None else Random()  # noqa: S311  # jitter, not secrets
        self._engine = LineEngine(settings, devices, clock.monotonic(), self._rng)
        self._char_s = settings.timing().char_s
        self._loop: asyncio.AbstractEventLoop | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._wake: asyncio.Handle | None = None
        self._port: _FilePort | _ThreadPort | None = None
        self._failed: asyncio.Future[str] | None = None
        for device in devices:
            device.line = self

    @property
    def name(self) -> str:
        """See `LinePort.name`."""
        return self.settings.name

    @property
    def index(self) -> int:
        """See `LinePort.index`."""
        return self.settings.index

    @property
    def port(self) -> str:
        """See `LinePort.port`."""
        return self.settings.port

    @property
    def stats(self) -> LineStats:
        """See `LinePort.stats`."""
        return self._engine.stats

    def status(self, now: float) -> LineStatus:
        """See `LinePort.status`."""
        return self._engine.status(now)

    def read(
        self, device: Device, pdu: bytes, done: Callable[[Outcome], None], *, client: str = "", background: bool = False
    ) -> Ticket:
        """See `LinePort.read`."""
        lane = Lane.BACKGROUND if background else Lane.CLIENT
        ticket = self._engine.read(device, pdu, done, self._clock.monotonic(), client=client, lane=lane)
        self._wake_up()
        return ticket

    def write(self, device: Device, pdu: bytes, done: Callable[[Outcome], None], *, client: str = "") -> Ticket:
        """See `LinePort.write`."""
        ticket = self._engine.write(device, pdu, done, self._clock.monotonic(), client=client)
        self._wake_up()
        return ticket

    def _wake_up(self) -> None:
        if self._wake is None:
            self._wake = asyncio.get_running_loop().call_soon(self._woken)

    async def run(self) -> None:
        """Own the port until cancelled: open it, serve it, and open it again when it fails."""
        self._loop = asyncio.get_running_loop()
        retry_s = FIRST_RETRY_S
        said = ""
        try:
            while True:
                try:
                    port = await asyncio.to_thread(open_port, self.settings)
                except PortError as error:
                    self._close(str(error))
                    if str(error) != said:  # once, not at every try
                        log.error('event=line_down line=%s reason="%s"', self.name, error)  # noqa: TRY400  # expected
                        said = str(error)
                else:
                    opened_at = self._clock.monotonic()
                    said = await self._serve(port)
                    log.error('event=line_down line=%s reason="%s"', self.name, said)
                    if self._clock.monotonic() - opened_at > LAST_RETRY_S:
                        retry_s = FIRST_RETRY_S
                await asyncio.sleep(retry_s * (1 + 0.1 * self._rng.random()))
                retry_s = min(2 * retry_s, LAST_RETRY_S)
        finally:
            self._close("stopped")

    async def _serve(self, port: serial.Serial) -> str:
        """Move bytes until the port fails; gives the reason."""
        loop = asyncio.get_running_loop()
        self._failed = loop.create_future()
        fd = _file_descriptor(port)
        shell = _ThreadPort(port, loop, self) if fd is None else _FilePort(port, fd, loop, self)
        try:
            await asyncio.sleep(SETTLE_S)
            shell.start()
            self._port = shell
            log.info('event=line_up line=%s port="%s"', self.name, self.port)
            self._engine.opened(self._clock.monotonic())
            self._advance()
            return await self._failed
        finally:
            self._port = None
            shell.stop()
            with contextlib.suppress(OSError, serial.SerialException):
                port.close()
            failed = self._failed.done() and not self._failed.cancelled() and self._failed.exception() is None
            self._close(self._failed.result() if failed else "stopped")

    def _close(self, reason: str) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self._engine.closed(reason, self._clock.monotonic())
        self._engine.step(self._clock.monotonic())  # hands out what ended with the line

    def _woken(self) -> None:
        self._wake = None
        self._advance()

    def on_bytes(self, data: bytes) -> None:
        """The port gave bytes."""
        self._advance(data)

    def on_failure(self, reason: str) -> None:
        """The port failed; `run` takes over."""
        if self._failed is not None and not self._failed.done():
            self._failed.set_result(reason)

    def wait_for_bytes_s(self) -> float:
        """Seconds until the rest of the awaited reply can have arrived."""
        return max(0, self._engine.bytes_due() - 1) * self._char_s

    def _advance(self, data: bytes = b"") -> None:
        """Let the engine act; its mistake ends `run`, which the service starts again, instead of hanging the line."""
        try:
            self._act(data)
        except Exception as error:
            if self._failed is None or self._failed.done():
                raise
            self._failed.set_exception(error)

    def _act(self, data: bytes) -> None:
        """Pass on bytes and time, write what the engine says, set the alarm for its next deadline."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        now = self._clock.monotonic()
        if data:
            self._engine.receive(data, now)
        self._engine.on_timer(now)
        frame = self._engine.step(self._clock.monotonic())
        if frame is not None and self._port is not None:
            self._port.write(frame)
        deadline = self._engine.next_deadline(self._clock.monotonic())
        if deadline is not None and self._loop is not None:
            delay_s = max(0.0, deadline - self._clock.monotonic())
            self._timer = self._loop.call_later(delay_s, self._on_timer)

    def _on_timer(self) -> None:
        self._timer = None
        self._advance()


class _FilePort:
    """A port with a file descriptor, on the event loop."""

    def __init__(self, port: serial.Serial, fd: int, loop: asyncio.AbstractEventLoop, line: SerialLine) -> None:
        self._port = port
        self._fd = fd
        self._loop = loop
        self._line = line
        self._rest = b""
        self._pause: asyncio.TimerHandle | None = None
        self._stopped = False

    def start(self) -> None:
        """Drop what came before and listen."""
        os.set_blocking(self._fd, False)
        with contextlib.suppress(OSError, serial.SerialException, AttributeError):
            self._port.reset_input_buffer()
        self._loop.add_reader(self._fd, self._readable)

    def stop(self) -> None:
        """Stop listening; the port may be closed after it."""
        self._stopped = True
        if self._pause is not None:
            self._pause.cancel()
        self._loop.remove_reader(self._fd)
        self._loop.remove_writer(self._fd)

    def write(self, frame: bytes) -> None:
        """Write a frame; what the kernel does not take now follows as soon as it does."""
        self._rest += frame
        self._writable()

    def _writable(self) -> None:
        try:
            written = os.write(self._fd, self._rest)
        except BlockingIOError:
            written = 0
        except OSError as error:
            self._line.on_failure(f"{self._line.port}: {error.strerror}")
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
        self._line.on_bytes(data)
        wait_s = self._line.wait_for_bytes_s()
        if wait_s > 0 and not self._stopped:
            self._loop.remove_reader(self._fd)
            self._pause = self._loop.call_later(wait_s, self._resume)

    def _resume(self) -> None:
        self._pause = None
        self._loop.add_reader(self._fd, self._readable)

    def _fail(self, reason: str) -> None:
        self._loop.remove_reader(self._fd)  # a dead descriptor is readable for ever
        self._line.on_failure(f"{self._line.port}: {reason}")


class _ThreadPort:
    """A port without a file descriptor (`rfc2217://`): one thread reads, the loop writes."""

    def __init__(self, port: serial.Serial, loop: asyncio.AbstractEventLoop, line: SerialLine) -> None:
        self._port = port
        self._loop = loop
        self._line = line
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._read, name=f"line-{line.name}", daemon=True)

    def start(self) -> None:
        """Drop what came before and listen."""
        self._port.reset_input_buffer()
        self._port.timeout = 0.1
        self._thread.start()

    def stop(self) -> None:
        """Stop listening; the thread ends by itself within its read time-out."""
        self._stopped.set()

    def write(self, frame: bytes) -> None:
        """Write a frame: eight bytes into a socket's buffer."""
        try:
            self._port.write(frame)
        except (OSError, serial.SerialException) as error:
            self._line.on_failure(f"{self._line.port}: {error}")

    def _read(self) -> None:
        try:
            while not self._stopped.is_set():
                data = self._port.read(max(1, self._port.in_waiting))
                if data and not self._stopped.is_set():
                    self._loop.call_soon_threadsafe(self._line.on_bytes, bytes(data))
        except (OSError, serial.SerialException, TypeError, AttributeError) as error:
            # pyserial raises TypeError or AttributeError when the port is closed under a read
            if not self._stopped.is_set():
                self._loop.call_soon_threadsafe(self._line.on_failure, f"{self._line.port}: {error}")


def _file_descriptor(port: serial.Serial) -> int | None:
    try:
        return int(port.fileno())
    except (io.UnsupportedOperation, AttributeError, OSError):
        return None
