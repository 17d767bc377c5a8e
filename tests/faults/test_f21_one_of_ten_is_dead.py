"""F21: one controller of ten on the line is switched off."""

from __future__ import annotations

import logging
from itertools import pairwise
from pathlib import Path
from random import Random

import pytest

from gateway.core.settings import PollSettings
from gateway.core.snapshot import DeviceState
from gateway.errors import DeviceOffline
from tests.faults.pty_rig import running
from tests.faults.rig import MakeRig, Rig, Unit, read
from tests.machine import Stopwatch

DEAD = 4
POLL = PollSettings(live_s=10.0, settings_s=600.0)


def latencies(line: Rig, seconds: float, unit: int | None = None) -> list[float]:
    """How long eight clients wait for their reads of the others (or of one unit), each asking again when answered."""
    rng = Random(21)
    waits: list[float] = []
    end = line.now + seconds
    others = [n for n in range(len(line.units)) if n != DEAD]

    def client(name: str) -> None:
        asked_at = line.now
        target = rng.choice(others) if unit is None else unit

        def answered(outcome: object) -> None:
            waits.append(line.now - asked_at)
            if line.now < end:
                client(name)

        line.read(target, read(rng.randrange(0, 70), 10), answered, client=name)

    for n in range(8):
        client(f"client-{n}")
    line.run(seconds + 10.0)
    return sorted(waits)


def p95(waits: list[float]) -> float:
    return waits[len(waits) * 95 // 100]


def test_the_others_hardly_notice(rig: MakeRig) -> None:
    healthy = rig(*map(Unit, range(10)), opened_s=20.0, poll=POLL)
    ill = rig(*map(Unit, range(10)), opened_s=20.0, poll=POLL)
    ill.units[DEAD].silent = True
    ill.run(60.0)
    assert ill.state(DEAD) is DeviceState.OFFLINE
    before, after = latencies(healthy, 200.0), latencies(ill, 200.0)
    assert len(before) > 1500
    assert p95(after) < 1.2 * p95(before)


def test_its_own_requests_are_0b_at_once(rig: MakeRig) -> None:
    line = rig(*map(Unit, range(10)), opened_s=20.0, poll=POLL)
    line.units[DEAD].silent = True
    line.run(60.0)
    begun = line.now
    outcome = line.ask(DEAD, read(0, 4))
    assert isinstance(outcome, DeviceOffline)
    assert outcome.exception_code == 0x0B
    assert line.now - begun < 0.02


def test_three_misses_then_probes_further_and_further_apart(rig: MakeRig) -> None:
    line = rig(*map(Unit, range(10)), opened_s=20.0, poll=POLL)
    line.units[DEAD].silent = True
    line.run(600.0)
    address = line.units[DEAD].address
    asked = [at for at, out in line.sent if out[0] == address and at > 1020.0]
    first = asked[2]  # the third miss
    pauses = [later - earlier for earlier, later in pairwise(asked[2:])]
    assert first - asked[0] < 35.0
    assert len(pauses) > 8, "it is asked for ever"
    for pause, least in zip(pauses, (4.5, 9, 18, 36, *[54] * len(pauses)), strict=False):
        assert least <= pause < least / 0.9 + 2.0
    assert line.devices[DEAD].stats.went_offline == 1


def test_one_log_line_down_and_one_up_with_the_duration(rig: MakeRig, caplog: pytest.LogCaptureFixture) -> None:
    line = rig(*map(Unit, range(10)), opened_s=20.0, poll=POLL)
    caplog.set_level(logging.INFO)
    caplog.clear()
    line.units[DEAD].silent = True
    line.run(300.0)
    line.units[DEAD].silent = False
    line.run(90.0)
    assert line.state(DEAD) is DeviceState.ONLINE
    told = [message for message in caplog.messages if "device=array-5 " in message]
    assert len(told) == 2
    assert "event=device_offline" in told[0]
    assert "event=device_online" in told[1]
    assert "lasted_s=" in told[1]


async def test_over_a_pty(tmp_path: Path) -> None:
    units = [Unit(n) for n in range(3)]
    async with running(tmp_path, *units, reply_timeout_s=0.3, poll=PollSettings(live_s=0.3)) as line:
        await line.online()
        units[1].silent = True
        await line.until(lambda: line.devices[1].snapshot.state is DeviceState.OFFLINE)
        watch = Stopwatch()
        assert isinstance(await line.ask(1, read(0, 4)), DeviceOffline)
        assert watch.s < 0.1
        for first in range(10):
            assert isinstance(await line.ask(0, read(first, 4)), bytes)
            assert isinstance(await line.ask(2, read(first, 4)), bytes)
