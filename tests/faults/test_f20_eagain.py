"""F20: a write to the port takes a part or nothing (EAGAIN); the port is ready to be read and there is nothing."""

from __future__ import annotations

import asyncio
import os
import select
import sys
import termios
import time
from pathlib import Path

import pytest

from tests.faults.pty_rig import running
from tests.faults.rig import read


class Reluctant:
    """`os` for one module, whose port takes three bytes at a time and now and then none."""

    def __init__(self) -> None:
        self.writes = self.refused = self.empty = 0

    def __getattr__(self, name: str) -> object:
        return getattr(os, name)

    def write(self, fd: int, data: bytes) -> int:
        self.writes += 1
        if self.writes % 3 == 1:
            self.refused += 1
            raise BlockingIOError
        return os.write(fd, data[:3])

    def read(self, fd: int, size: int) -> bytes:
        self.empty += 1
        if self.empty % 4 == 1:
            raise BlockingIOError
        return os.read(fd, size)


@pytest.fixture
def reluctant(monkeypatch: pytest.MonkeyPatch) -> Reluctant:
    fake = Reluctant()
    for name in ("serial", "transports"):
        module = sys.modules.get(f"gateway.lines.{name}")
        if module is not None and hasattr(module, "os"):
            monkeypatch.setattr(module, "os", fake)
    return fake


async def test_no_byte_is_lost_and_none_twice(tmp_path: Path, reluctant: Reluctant) -> None:
    async with running(tmp_path, gap_s=0.05) as line:  # a frame in pieces is one frame, however busy the machine
        await line.online()
        for first in range(20):
            assert isinstance(await line.ask(0, read(first, 30)), bytes)
        assert reluctant.refused >= 20
        assert reluctant.empty >= 20
        assert line.wire.counters.bad_frames == 0
        assert line.line.stats.failed["timeout"] == 0


async def test_a_port_that_is_ready_and_empty_has_not_hung_up(tmp_path: Path) -> None:
    """Somebody else empties the terminal's buffer between the readiness and the read."""
    async with running(tmp_path, reply_timeout_s=0.3) as line:
        await line.online()
        loop = asyncio.get_running_loop()
        other = os.open(line.device_path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)

        def fill() -> None:
            master = line.pty._master
            assert master is not None
            os.write(master, b"noise")
            assert select.select([other], [], [], 1.0)[0]
            loop.call_soon(termios.tcflush, other, termios.TCIFLUSH)  # runs before the reader that is woken now

        try:
            for _ in range(5):
                loop.call_soon(fill)
                await asyncio.sleep(0.01)
        finally:
            os.close(other)
        assert isinstance(await line.ask(0, read(0, 4)), bytes)
        assert line.line.stats.opens == 1


async def test_a_port_that_takes_no_bytes_is_a_time_out_and_no_spin(tmp_path: Path) -> None:
    async with running(tmp_path, reply_timeout_s=0.2, retries=0) as line:
        await line.online()
        assert line.pty._master is not None
        asyncio.get_running_loop().remove_reader(line.pty._master)  # nobody reads any more
        cpu, wall = time.process_time(), time.monotonic()
        outcomes = [await line.ask(0, read(n, 2)) for n in range(3)]
        assert not any(isinstance(outcome, bytes) for outcome in outcomes)
        assert time.process_time() - cpu < 0.3 * (time.monotonic() - wall) + 0.05
