"""A simulated line as a real serial port: a pty whose bytes take their time.

The client opens `path` like any serial device; what the line does and when is `line.py`'s business. Nothing runs
while the line is silent: the loop wakes for bytes from the client and for the line's next event, no more.

The pty is raw and 8-bit clean before any client opens it. The simulator keeps the client's end open too, so that
a client that comes and goes is no hang-up (a hung-up pty master is always readable and would burn the processor).
Bytes nobody reads stay in the terminal's buffer as they would in a driver's; beyond that they are lost and counted.
"""

from __future__ import annotations

import asyncio
import logging
import os
import tty
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Self

from gateway.clock import Clock, SystemClock
from gateway.simulator.line import SimulatedLine

_READ_SIZE = 4096

log = logging.getLogger(__name__)


class PtyLine:
    """One line on a pty; use it as an async context manager, or `open` and `close` it inside a running loop.

    `link` is a symlink that always leads to the present pty, like udev's /dev/serial/by-id.
    """

    def __init__(self, line: SimulatedLine, *, link: Path | None = None, clock: Clock | None = None) -> None:
        self.line = line
        self.link = link
        self.lost_bytes = 0
        self._clock = clock or SystemClock()
        self._master: int | None = None
        self._slave: int | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._device = ""

    @property
    def path(self) -> str:
        """What a client opens: the link, or the pty itself when there is none. OSError while unplugged without link."""
        if self.link is not None:
            return str(self.link)
        if self._master is None:
            raise OSError("the line is unplugged")
        return self._device

    @property
    def device(self) -> str:
        """The pty itself, behind the link; that of the last time while unplugged."""
        return self._device

    @property
    def plugged(self) -> bool:
        """Whether there is a pty now."""
        return self._master is not None

    def open(self) -> None:
        """Make a pty, let the link lead to it, begin to listen; OSError when the system refuses."""
        if self._master is not None:
            return
        master, slave = os.openpty()
        try:
            tty.setraw(slave)
            os.set_blocking(master, False)
            device = os.ttyname(slave)
            if self.link is not None:
                _move_link(self.link, device)
        except OSError:
            os.close(master)
            os.close(slave)
            raise
        self._master, self._slave, self._device = master, slave, device
        asyncio.get_running_loop().add_reader(master, self._readable)

    def close(self) -> None:
        """End: the client's file descriptor hangs up and the link goes."""
        self.unplug()

    def unplug(self) -> None:
        """Pull the adapter: the client's file descriptor hangs up and the link goes, as udev would do."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        if self._master is None or self._slave is None:
            return
        asyncio.get_running_loop().remove_reader(self._master)
        if self.link is not None:
            self.link.unlink(missing_ok=True)
        os.close(self._master)
        os.close(self._slave)
        self._master = self._slave = None

    def replug(self) -> None:
        """Plug the adapter in again: a new pty, usually under another name, and the link moved to it."""
        self.unplug()
        self.line.clear()
        self.open()

    async def __aenter__(self) -> Self:
        self.open()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _readable(self) -> None:
        if self._master is None:
            return
        with suppress(BlockingIOError):
            self.line.receive(os.read(self._master, _READ_SIZE), self._clock.monotonic())
        self._serve()

    def _serve(self) -> None:
        """Hand over what has arrived and set the timer for what comes next."""
        now = self._clock.monotonic()
        arrived = self.line.take(now)
        if arrived and self._master is not None:
            self._write(self._master, arrived)
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        due = self.line.next_event()
        if due is not None:
            self._timer = asyncio.get_running_loop().call_later(max(0.0, due - now), self._serve)

    def _write(self, master: int, data: bytes) -> None:
        written = 0
        with suppress(BlockingIOError):
            written = os.write(master, data)
        if written < len(data):
            if not self.lost_bytes:
                log.warning("nobody reads the simulated line device=%s", self._device)
            self.lost_bytes += len(data) - written


def _move_link(link: Path, target: str) -> None:
    """Let `link` lead to `target` in one step, never nowhere in between; FileExistsError when a file is there."""
    if link.exists() and not link.is_symlink():
        raise FileExistsError(f"{link} is there already and is no symlink")
    fresh = link.with_name(f".{link.name}.{os.getpid()}")
    fresh.unlink(missing_ok=True)
    fresh.symlink_to(target)
    fresh.replace(link)
