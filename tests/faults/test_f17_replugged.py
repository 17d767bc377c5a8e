"""F17: the adapter is plugged in again and has another name now; the configured link leads to it."""

from __future__ import annotations

import os
import time
from itertools import pairwise
from pathlib import Path

import pytest
import serial

import gateway.lines.serial as shell
from gateway.core.settings import LineSettings, PollSettings
from gateway.core.snapshot import DeviceState
from gateway.lines.ports import open_port
from tests.faults.pty_rig import running
from tests.faults.rig import read
from tests.machine import Bystander


def take_name(device_path: str) -> list[int]:
    """Open ptys until one has that name, so that the adapter comes back under another one."""
    held: list[int] = []
    while not Path(device_path).exists():
        held += os.openpty()
    return held


def watched(monkeypatch: pytest.MonkeyPatch) -> tuple[list[float], list[float]]:
    """When a port was looked for, and when one was opened."""
    looked: list[float] = []
    opened: list[float] = []

    def look(settings: LineSettings) -> serial.Serial:
        looked.append(time.monotonic())
        port = open_port(settings)
        opened.append(time.monotonic())
        return port

    monkeypatch.setattr(shell, "open_port", look)
    return looked, opened


async def test_it_is_opened_again_by_its_link_after_a_settling_time_with_fresh_data(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, passing: Bystander
) -> None:
    _, opened = watched(monkeypatch)
    async with running(tmp_path, poll=PollSettings(live_s=0.2)) as line:
        await line.until(lambda: line.devices[0].snapshot.state is DeviceState.ONLINE)
        first_name = line.device_path
        line.pty.unplug()
        await line.until(lambda: not line.up and not Path(first_name).exists())
        spare = take_name(first_name)
        try:
            requests = line.wire.counters.requests
            line.pty.open()
            plugged_at = time.monotonic()
            passing.start()
            assert line.device_path != first_name
            await line.until(lambda: line.wire.counters.requests > requests)
            assert time.monotonic() - opened[1] >= shell.SETTLE_S
            await line.until(lambda: line.devices[0].snapshot.state is DeviceState.ONLINE)
            assert passing.stop() < 10.0  # a tenth of it where nothing else runs
            line.judge_snapshots()
            assert min(block.read_at for block in line.devices[0].snapshot.blocks) > plugged_at
            assert isinstance(await line.ask(0, read(0, 4)), bytes)
            assert line.line.stats.opens == 2
        finally:
            for fd in spare:
                os.close(fd)


async def test_a_port_that_stays_away_is_looked_for_with_growing_pauses(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shell, "LAST_RETRY_S", 0.4)
    looked, _ = watched(monkeypatch)
    async with running(tmp_path, plugged=False) as line:
        await line.until(lambda: len(looked) >= 6)
        pauses = [later - earlier for earlier, later in pairwise(looked)]
        for pause, least in zip(pauses, (0.1, 0.2, 0.4, 0.4, 0.4), strict=False):
            assert pause >= 0.9 * least  # the jitter
        line.pty.open()
        await line.online()


def test_the_pauses_begin_at_a_tenth_of_a_second_and_end_below_five() -> None:
    assert shell.SETTLE_S == 0.2
    assert shell.FIRST_RETRY_S == 0.1
    assert 4.0 <= shell.LAST_RETRY_S <= 5.0
