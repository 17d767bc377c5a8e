"""What the tests of a running line share."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import TypeVar

from gateway.clock import SystemClock
from gateway.core.settings import LineSettings
from gateway.core.site import Device, Outcome
from gateway.lines.serial import SerialLine
from gateway.lines.upstream import UpstreamLine
from gateway.modbus.pdu import Function, ReadRequest
from tests.machine import Stopwatch

Line = TypeVar("Line", SerialLine, UpstreamLine)


@contextlib.asynccontextmanager
async def running(line: Line) -> AsyncIterator[Line]:
    task = asyncio.create_task(line.run())
    try:
        yield line
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task


def make_line(port: Path | str, device: Device, **settings: object) -> SerialLine:
    line_settings = LineSettings(name="shelter-a", index=1, port=str(port), reply_timeout_s=0.1, **settings)  # type: ignore[arg-type]  # the tests' own calls
    return SerialLine(line_settings, [device], SystemClock())


async def until(condition: Callable[[], bool], limit_s: float = 30.0) -> None:
    """Wait for a state that only the outside world brings about."""
    async with asyncio.timeout(limit_s):
        while not condition():  # noqa: ASYNC110  # the snapshot is replaced without an event
            await asyncio.sleep(0.01)


async def ask(line: SerialLine | UpstreamLine, device: Device, address: int, count: int = 1) -> Outcome:
    done: asyncio.Future[Outcome] = asyncio.get_running_loop().create_future()
    line.read(device, ReadRequest(Function.READ_HOLDING_REGISTERS, address, count).encode(), done.set_result)
    async with asyncio.timeout(30):
        return await done


class LoopLag:
    """The longest time in which the loop did nothing else, in seconds; time that other processes took is left out."""

    def __init__(self) -> None:
        self.worst_s = 0.0

    async def measure(self) -> None:
        """Run beside what is measured until cancelled."""
        while True:
            watch = Stopwatch()
            await asyncio.sleep(0.005)
            self.worst_s = max(self.worst_s, watch.s - 0.005)


@contextlib.asynccontextmanager
async def lag_meter() -> AsyncIterator[LoopLag]:
    """Measures for the time of the block."""
    lag = LoopLag()
    task = asyncio.create_task(lag.measure())
    try:
        yield lag
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task


class SleepingClock(SystemClock):
    """Of a machine that slept for `slept_s`, in which no timer ran."""

    slept_s = 0.0
    looks = 0  # how often somebody asked it

    def monotonic(self) -> float:
        self.looks += 1
        return time.monotonic() + self.slept_s
