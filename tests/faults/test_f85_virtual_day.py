"""F85: polling round the clock on a line with three devices and 0.1 % faults of every kind, in virtual time.

Every transaction is accounted for, memory stays flat, and the oracle sees no wrong value.
"""

from __future__ import annotations

import gc
import logging
import sys
import tracemalloc
from collections.abc import Iterator
from random import Random

import pytest

from gateway.core.settings import PollSettings
from gateway.core.snapshot import DeviceState
from gateway.simulator.chaos import Chaos, Fault, all_at
from gateway.simulator.oracle import REMEMBERED, Verdict
from tests.faults.rig import Rig, Unit, make_rig, read

HOUR_S = 3600.0
ASK_EVERY_S = 20.0


def live(rig: Rig, seconds: float, rng: Random) -> None:
    """Let time pass with a client that asks now and then for what is not polled."""
    end = rig.now + seconds
    while rig.now < end:
        rig.read(rng.randrange(3), read(0x8000 + rng.randrange(0xF00), rng.randint(1, 60)), client="historian")
        rig.run(min(ASK_EVERY_S, end - rig.now))
        rig.sent.clear()
        for unit in rig.units:
            unit.asked.clear()


def allocated_blocks() -> int:
    """Memory blocks in use, all of them: counting costs nothing, so the whole day can be watched."""
    gc.collect()
    return sys.getallocatedblocks()


def traced_bytes(rig: Rig, seconds: float, rng: Random) -> int:
    """How much more is held after that time than before, of what was allocated meanwhile."""
    tracemalloc.start()
    try:
        live(rig, seconds, rng)
        gc.collect()
        return tracemalloc.get_traced_memory()[0]
    finally:
        tracemalloc.stop()


def watch(hours: int, live_s: float) -> None:
    """At first what is bounded fills up, the oracle's own memory too; from then on nothing must grow."""
    chaos = Chaos(85, all_at(0.001, but=frozenset()))
    poll = PollSettings(live_s=live_s, settings_s=300.0)
    rig = make_rig(Unit(0), Unit(1), Unit(2), medium=chaos, poll=poll, wake_bytes=256)  # few events: it is a long day
    rng = Random(85)
    blocks: list[int] = []
    with chaos:
        for _ in range(12 * hours):
            live(rig, HOUR_S / 12, rng)
            rig.account()
            if min(unit.sequence for unit in rig.units) > REMEMBERED + 300:
                blocks.append(allocated_blocks())
        short, longer = (traced_bytes(rig, seconds, rng) for seconds in (60.0, 240.0))
        chaos.stop()
        rig.run(120.0)
        rig.account()
        stats = rig.engine.stats
        assert [rig.state(n) for n in range(3)] == [DeviceState.ONLINE] * 3
        assert stats.sent > 2 * 3 * hours * HOUR_S / live_s * 0.9
        assert stats.sent == stats.ok + stats.failed.total() + (len(rig.engine._under_way))
        assert set(rig.verdicts) == {Verdict.RIGHT}
        assert rig.verdicts.total() > 0.9 * stats.ok
        assert len(chaos.counts) >= (len(Fault) if hours > 4 else 10)
        assert rising(blocks) < 500, blocks
        assert longer < 2 * short + 50_000, "what is held grows with time"


def rising(samples: list[int]) -> int:
    """By how much the least of the second half is above the least of the first."""
    half = (len(samples) + 1) // 2
    return min(samples[half:]) - min(samples[:half])


@pytest.fixture(autouse=True)
def quiet() -> Iterator[None]:
    """The log of a day, kept by pytest, would be the memory that grows."""
    logging.disable(logging.CRITICAL)
    yield
    logging.disable(logging.NOTSET)


def test_an_hour() -> None:
    watch(hours=1, live_s=2.0)


@pytest.mark.long
def test_a_day() -> None:
    watch(hours=24, live_s=5.0)
