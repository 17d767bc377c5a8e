"""F40: tens of thousands of mutated streams: documented outcomes only, memory flat, no turn of the loop above 50 ms."""

from __future__ import annotations

import gc
import logging
import os
import time
import tracemalloc
from random import Random

import pytest

from tests.fuzz.modbus_tcp import Target, mutated

SECONDS = 3.0
LOOP_LAG_S = 0.05


@pytest.fixture
def seed() -> int:
    return 40 if os.environ.get("CI") else Random().randrange(1 << 32)


async def test_nothing_grows_and_nothing_lasts(seed: int, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.CRITICAL)
    rng = Random(seed)
    target = Target()
    for _ in range(200):  # what is kept on purpose is full now
        await target.feed(*mutated(rng))
    until = time.monotonic() + SECONDS
    count = 0
    while time.monotonic() < until:
        stream, cuts = mutated(rng)
        try:
            await target.feed(stream, cuts)
        except AssertionError as error:
            error.add_note(f"seed {seed}, stream {count}: {stream.hex()} cut at {cuts}")
            raise
        count += 1
    assert count > 100
    assert target.slowest_s < LOOP_LAG_S
    gc.collect()
    tracemalloc.start()
    for _ in range(50):
        await target.feed(*mutated(rng))
    gc.collect()
    before = tracemalloc.get_traced_memory()[0]
    for _ in range(200):
        await target.feed(*mutated(rng))
    gc.collect()
    grown = tracemalloc.get_traced_memory()[0] - before
    tracemalloc.stop()
    assert grown < 256 * 1024, f"seed {seed}: {grown} bytes more after 200 streams"
