"""kill -9 during the harvest, at random moments: nothing is lost, nothing is there twice, nothing is there half.

The harvester is a process over a simulated line on a pty at 115200 baud, so that a ring takes about a second.
"""

from __future__ import annotations

import asyncio
import os
import random
import sqlite3
import sys
from collections.abc import AsyncIterator
from contextlib import closing
from pathlib import Path

import pytest

from gateway.devices.log import decode_log, split_blocks
from gateway.devices.model import Space, WordOrder
from gateway.history.database import FILE_NAME
from gateway.modbus.rtu import Timing
from gateway.simulator.device import SimulatedController
from gateway.simulator.line import SimulatedLine
from gateway.simulator.pty import PtyLine
from tests.history.blocks import LAYOUT, MAP
from tests.history.harvester import BAUDRATE

REPOSITORY = Path(__file__).parents[2]


@pytest.fixture
def controller() -> SimulatedController:
    return SimulatedController(MAP, seed=0, turnaround_s=0.004, log_order=WordOrder.LO_HI)


@pytest.fixture
async def port(controller: SimulatedController, tmp_path: Path) -> AsyncIterator[str]:
    line = SimulatedLine([controller], timing=Timing.of(BAUDRATE, 8, "N", 2))
    async with PtyLine(line, link=tmp_path / "line"):
        yield str(tmp_path / "line")


def truth(controller: SimulatedController) -> dict[int, bytes]:
    words = controller.memory.read(Space.REGISTERS, LAYOUT.first, LAYOUT.blocks * LAYOUT.block_words)
    ring = split_blocks(LAYOUT, b"".join(word.to_bytes(2, "big") for word in words))
    return {day.hourmeter: ring[day.slot] for day in decode_log(LAYOUT, ring).days}


def check(directory: Path, expected: dict[int, bytes]) -> tuple[int, int]:
    """Days and staged blocks of a file that a killed process left; fails when anything in it is not whole."""
    if not (directory / FILE_NAME).exists():
        return 0, 0
    with closing(sqlite3.connect(directory / FILE_NAME)) as connection:
        assert connection.execute("PRAGMA integrity_check").fetchall() == [("ok",)]
        if not connection.execute("SELECT 1 FROM sqlite_schema WHERE name = 'day'").fetchall():
            return 0, 0
        days = connection.execute("SELECT controller, hourmeter, words FROM day").fetchall()
        staged = connection.execute("SELECT words FROM staged").fetchall()
        (controllers,) = connection.execute("SELECT count(*) FROM controller").fetchone()
    assert controllers <= 1
    assert len(days) in {0, len(expected)}, "a ring is stored whole"
    assert {hourmeter: words for _, hourmeter, words in days} == (expected if days else {})
    assert len(days) == len({hourmeter for _, hourmeter, _ in days})
    assert {words for (words,) in staged} <= set(expected.values())
    return len(days), len(staged)


async def harvest(port: str, directory: Path, kill_after_s: float | None) -> bool:
    """Run the harvester; whether it came to the end of its harvest before it was killed."""
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "tests.history.harvester", port, str(directory)),
        cwd=REPOSITORY,
        stdout=asyncio.subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": str(REPOSITORY), "COVERAGE_PROCESS_START": ""},
    )
    assert process.stdout is not None
    try:
        assert await process.stdout.readline() == b"started\n"
        async with asyncio.timeout(kill_after_s if kill_after_s is not None else 60.0):
            return await process.stdout.readline() == b"harvested\n"
    except TimeoutError:
        return False
    finally:
        process.kill()
        await process.wait()


async def kill_at_random(controller: SimulatedController, port: str, folder: Path, kills: int) -> int:
    """Gives how often a reading went on from where a killed process left it."""
    expected = truth(controller)
    assert len(expected) == 256
    began = asyncio.get_running_loop().time()
    assert await harvest(port, folder / "whole", None)
    whole_s = asyncio.get_running_loop().time() - began
    number = resumed = killed = staged_before = 0
    while killed < kills:
        directory = folder / f"state-{number}"
        finished = await harvest(port, directory, random.uniform(0.1, 0.8) * whole_s)  # seeded by pytest-randomly
        killed += not finished
        days, staged = await asyncio.to_thread(check, directory, expected)
        assert days or staged >= staged_before, "what was staged is not lost"
        resumed += bool(staged_before) and (staged > staged_before or bool(days))
        staged_before = staged
        if days:
            number, staged_before = number + 1, 0
    directory = folder / f"state-{number}"
    assert await harvest(port, directory, None)
    assert await asyncio.to_thread(check, directory, expected) == (256, 0)
    return resumed


async def test_a_few_kills_lose_and_double_nothing(controller: SimulatedController, port: str, tmp_path: Path) -> None:
    await kill_at_random(controller, port, tmp_path, kills=6)


@pytest.mark.long
@pytest.mark.timeout(1200)
async def test_a_hundred_kills_lose_and_double_nothing(
    controller: SimulatedController, port: str, tmp_path: Path
) -> None:
    assert await kill_at_random(controller, port, tmp_path, kills=100) > 10
