"""F87: the adapter is unplugged and plugged in again, time after time; nothing leaks and nothing slows down.

The pauses of the shell are shortened, else a thousand cycles would take hours; everything else is as in service.
"""

from __future__ import annotations

import asyncio
import gc
import threading
from dataclasses import dataclass
from pathlib import Path

import pytest

import gateway.lines.serial as shell
from gateway.simulator.chaos import Chaos, Fault
from tests.faults.pty_rig import PtyRig, running
from tests.faults.rig import read
from tests.machine import Stopwatch

WARM_UP = 3


@dataclass(frozen=True, slots=True)
class Held:
    """What a process holds that must come back to what it was."""

    descriptors: int
    tasks: int
    threads: int

    @classmethod
    def now(cls) -> Held:
        return cls(sum(1 for _ in Path("/proc/self/fd").iterdir()), len(asyncio.all_tasks()), threading.active_count())


@pytest.fixture
def hasty(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shell, "SETTLE_S", 0.0)
    monkeypatch.setattr(shell, "FIRST_RETRY_S", 0.005)
    monkeypatch.setattr(shell, "LAST_RETRY_S", 0.005)


async def cycle(line: PtyRig, number: int) -> float:
    """Unplug, in the middle of a transaction or not, and plug in again; gives our seconds until the line is up."""
    opens = line.line.stats.opens
    if number % 3 == 0:
        waiting = asyncio.ensure_future(line.ask(0, read(0, 40)))
        if number % 2:
            await asyncio.sleep(0)
        line.pty.unplug()
        await waiting
    else:
        line.pty.unplug()
    await line.until(lambda: not line.up)
    watch = Stopwatch()
    line.pty.replug()
    await line.until(lambda: line.up and line.line.stats.opens == opens + 1)
    return watch.s


async def settled() -> Held:
    """What is held when everything that ends by itself has ended: the same for a while."""
    gc.collect()
    held, since = Held.now(), 0
    for _ in range(1000):
        await asyncio.sleep(0.01)
        seen = Held.now()
        held, since = (held, since + 1) if seen == held else (seen, 0)
        if since == 20:
            break
    return held


async def cycles(folder: Path, count: int) -> None:
    async with running(folder, retries=0, reply_timeout_s=0.5) as line:
        await line.online()
        for number in range(WARM_UP):
            await cycle(line, number)
        before = await settled()
        took_s = [await cycle(line, number) for number in range(count)]
        assert await settled() == before
        tenth = max(5, count // 10)
        first, last = sorted(took_s[:tenth]), sorted(took_s[-tenth:])
        assert last[len(last) // 2] < 3 * first[len(first) // 2] + 0.05
        assert line.line.stats.opens == 1 + WARM_UP + count
        await line.online()  # one that a busy machine let seem silent is asked once a minute
        assert isinstance(await line.ask(0, read(0, 40)), bytes)


@pytest.mark.usefixtures("hasty")
async def test_thirty_cycles(tmp_path: Path) -> None:
    await cycles(tmp_path, 30)


@pytest.mark.long
@pytest.mark.usefixtures("hasty")
async def test_a_thousand_cycles(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("CRITICAL")
    await cycles(tmp_path, 1000)


@pytest.mark.usefixtures("hasty")
async def test_ports_that_close_and_unplug_under_traffic(tmp_path: Path) -> None:
    """The faults come from the chaos in the line, at any byte of a transaction."""
    chaos = Chaos(87, {Fault.CLOSE: 0.1, Fault.UNPLUG: 0.1})
    async with running(tmp_path, medium=chaos, retries=0, reply_timeout_s=0.5) as line:
        loop = asyncio.get_running_loop()

        def port_fault(fault: Fault) -> None:
            loop.call_soon(line.pty.unplug)
            loop.call_later(0.0 if fault is Fault.CLOSE else 0.1, line.pty.replug)

        chaos.on_port_fault = port_fault
        first = 0
        async with asyncio.timeout(60.0):
            while first < 40 or line.line.stats.opens <= 3:
                await line.until(lambda: line.up)
                await line.ask(0, read(first % 40, 10))
                first += 1
        chaos.stop()
        await line.until(lambda: line.up)
        await line.online()
