"""The socket at which a line is watched: who does not read loses pieces, and the gateway keeps little for him."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import re
import socket
from pathlib import Path

import pytest

from gateway.clock import SystemClock
from gateway.core.site import Device
from gateway.devices.unknown import UNKNOWN
from gateway.modbus.recording import Recording
from gateway.service import tracing
from gateway.service.tracing import FILE_NAME, Tracer
from tests.lines.rig import make_line, until

PIECE = bytes(1000)
TOLD = 4000
"""Pieces: as text eight times what is kept for a watcher, and more than the kernel takes besides."""


async def test_who_does_not_read_loses_pieces_which_are_counted_and_is_given_the_others(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    clock = SystemClock()
    line = make_line(tmp_path / "none", Device("array-1", 11, 1, UNKNOWN))
    tracer = asyncio.create_task(Tracer(tmp_path, lambda: [line], clock).run())
    path = tmp_path / FILE_NAME
    await until(path.exists)
    with socket.socket(socket.AF_UNIX) as watcher:
        watcher.connect(str(path))
        watcher.sendall(b'"shelter-a"\n')
        await until(lambda: bool(line.tap))
        for number in range(TOLD):
            line.tap.tell(clock.monotonic(), sent=bool(number % 2), data=PIECE)
            if number % 100 == 0:
                await asyncio.sleep(0)
        watcher.shutdown(socket.SHUT_WR)
        await until(lambda: not line.tap)
        got = await asyncio.to_thread(watcher.makefile().read)
    tracer.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await tracer
    lost = re.search(r"event=trace line=shelter-a state=off lasted_s=\S+ lost=(\d+)$", caplog.text, re.MULTILINE)
    assert lost is not None
    assert int(lost[1]) > TOLD / 2
    assert len(got) < 2 * tracing.MOST_UNREAD
    assert len(Recording.parse(got.splitlines()).pieces) == TOLD - int(lost[1])


async def test_a_line_that_a_reload_takes_away_ends_what_is_made_of_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    monkeypatch.setattr(tracing, "LOOK_S", 0.01)
    device = Device("array-1", 11, 1, UNKNOWN)
    before, after = make_line(tmp_path / "none", device), make_line(tmp_path / "none", device)
    lines = [before]
    tracer = asyncio.create_task(Tracer(tmp_path, lambda: lines, SystemClock()).run())
    path = tmp_path / FILE_NAME
    await until(path.exists)
    for line in (before, after):
        lines[:] = [line]
        reader, writer = await asyncio.open_unix_connection(path)
        writer.write(b'"shelter-a"\n')
        await until(lambda line=line: bool(line.tap))  # type: ignore[misc]
        line.tap.tell(SystemClock().monotonic(), sent=True, data=PIECE)
        lines.clear()
        async with asyncio.timeout(30):
            assert len(Recording.parse((await reader.read()).decode().splitlines()).pieces) == 1
        assert not line.tap
        writer.close()
    assert caplog.text.count("state=off") == 2
    tracer.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await tracer
