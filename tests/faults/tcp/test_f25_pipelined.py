"""F25: 16 pipelined requests to 3 units in one segment, mixed cached and serial: each its own reply, in order."""

from __future__ import annotations

import asyncio
from random import Random

import pytest

from gateway.faces.modbus.connection import MAX_WAITING
from gateway.modbus import mbap
from tests.faces.modbus.conftest import Running, read


async def test_sixteen_to_three_units_cached_and_serial(running: Running) -> None:
    running.world.poll(12)  # 11 and 21 have to be asked
    client = await running.connect()
    asked = []
    for at in range(16):
        unit = (11, 12, 21)[at % 3]
        asked.append((1000 + at, unit, *read(unit, at, 1 + at)))
    client.send(b"".join(mbap.encode(tid, unit, request) for tid, unit, request, _ in asked))
    assert await client.adus(16) == [mbap.Adu(tid, unit, reply) for tid, unit, _, reply in asked]


@pytest.mark.parametrize("held", [False, True])
async def test_200_pipelined_requests_to_three_units(running: Running, held: bool) -> None:
    running.world.poll(12)
    for line in running.world.lines:
        line.held = held
    client = await running.connect()
    rng = Random(7)
    asked = []
    for tid in range(200):
        unit = rng.choice((11, 12, 12, 21))
        asked.append((tid, unit, *read(unit, rng.randrange(60), rng.randrange(1, 20))))
    client.send(b"".join(mbap.encode(tid, unit, request) for tid, unit, request, _ in asked))

    async def let_lines_answer() -> None:
        while True:
            await running.until(lambda: any(line.waiting for line in running.world.lines))
            for line in running.world.lines:
                assert len(line.waiting) <= MAX_WAITING
                line.release()

    async with asyncio.TaskGroup() as group:
        lines = group.create_task(let_lines_answer()) if held else None
        replies = await client.adus(200)
        if lines is not None:
            lines.cancel()
    assert replies == [mbap.Adu(tid, unit, reply) for tid, unit, _, reply in asked]
    assert running.world.stats.requests == 200
    assert running.world.stats.cache_hits + running.world.stats.forwarded == 200
