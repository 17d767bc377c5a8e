"""F19: another process has the port: a getty, ModemManager, a second gateway."""

from __future__ import annotations

import asyncio
import os
import sys
from pathlib import Path

import pytest

from tests.faults.pty_rig import running
from tests.faults.rig import read
from tests.faults.test_f17_replugged import watched

HOLD = """
import fcntl, os, sys
fd = os.open(sys.argv[1], os.O_RDWR | os.O_NOCTTY)
fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
"""

PORT = """
import fcntl, os, sys
master, slave = os.openpty()
fcntl.flock(slave, fcntl.LOCK_EX | fcntl.LOCK_NB)
os.symlink(os.ttyname(slave), sys.argv[1])
sys.stdin.readline()
fcntl.flock(slave, fcntl.LOCK_UN)
sys.stdin.readline()
"""
"""A port that its maker itself holds, until it is told to let go."""


async def test_the_message_names_the_holder_once_and_the_port_is_taken_when_it_is_free(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    looked, _ = watched(monkeypatch)
    link = str(tmp_path / "ttyUSB0")
    holder = await asyncio.create_subprocess_exec(sys.executable, "-c", PORT, link, stdin=asyncio.subprocess.PIPE)
    assert holder.stdin is not None
    try:
        async with running(tmp_path, plugged=False) as line:
            await line.until(lambda: "in use by" in line.line.status(line.clock.monotonic()).error)
            error = line.line.status(line.clock.monotonic()).error
            assert f"process {holder.pid}" in error
            assert "python" in error
            assert link in error
            tried = len(looked)
            await line.until(lambda: len(looked) >= tried + 2)
            complaints = [message for message in caplog.messages if "in use by" in message]
            assert len(complaints) == 1
            holder.stdin.write(b"let go\n")
            await line.until(lambda: line.up)
    finally:
        holder.stdin.close()
        await holder.wait()


async def test_the_lock_keeps_others_that_ask_for_it_out(tmp_path: Path) -> None:
    async with running(tmp_path) as line:
        await line.online()
        other = await asyncio.create_subprocess_exec(
            sys.executable,
            "-c",
            HOLD,
            line.device_path,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.PIPE,
        )
        _, errors = await other.communicate()
        assert b"BlockingIOError" in errors


async def test_modem_commands_that_a_stranger_wrote_are_noise(tmp_path: Path) -> None:
    async with running(tmp_path, reply_timeout_s=0.3) as line:
        await line.online()
        stranger = os.open(line.device_path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        try:
            for n in range(5):
                asking = asyncio.ensure_future(line.ask(0, read(n, 20)))
                await asyncio.sleep(0)
                os.write(stranger, b"AT+GCAP\r")
                await asking
                assert isinstance(await line.ask(0, read(n, 20)), bytes)
        finally:
            os.close(stranger)
