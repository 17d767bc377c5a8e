"""The log is read in idle line time only: however little there is, and not at all where there is none."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import pytest

from gateway.core.budget import line_budget
from gateway.core.settings import LineSettings, PollSettings
from gateway.history.keeper import CROWDED_S, LONG_S
from gateway.simulator.device import SimulatedController
from tests.history.blocks import MAP
from tests.history.test_keeper import stored, truth
from tests.history.virtual_site import VirtualClock, VirtualGateway, VirtualPort

UNITS = 3


def live_s_for(use: float) -> float:
    """How often live values are wanted for the polls to take this share of the line."""
    settings = LineSettings(name="line", index=1, port="virtual", poll=PollSettings(1.0, 86400.0))
    ratio = line_budget(settings, [MAP] * UNITS).use_ratio
    assert ratio is not None, "it is a serial line"
    return ratio / use


def site(tmp_path: Path, live_s: float) -> tuple[list[SimulatedController], VirtualGateway]:
    clock = VirtualClock()
    units = [SimulatedController(MAP, address=n, seed=n, step_s=60.0) for n in range(1, UNITS + 1)]
    return units, VirtualGateway(tmp_path, clock, VirtualPort(clock, list(units), live_s, settings_s=86400.0))


def log_reads(running: VirtualGateway) -> list[bytes]:
    return [frame for _, frame in running.port.sent if frame[1] == 3 and 0x80 <= frame[2] < 0xE0]


def longest_period_s(running: VirtualGateway, address: int, since: float) -> float:
    polls = [at for at, frame in running.port.sent if at > since and frame[:4] == bytes((address, 4, 0, 0))]
    polls = polls or [at for at, frame in running.port.sent if at > since and frame[:4] == bytes((address, 3, 0, 0))]
    assert len(polls) > 20
    return max(later - earlier for earlier, later in pairwise(polls))


@pytest.mark.parametrize("use", [0.6, 0.85])
async def test_little_idle_time_is_enough_and_no_poll_is_late_for_it(tmp_path: Path, use: float) -> None:
    live_s = live_s_for(use)
    units, gateway = site(tmp_path, live_s)
    async with gateway as running:
        await running.run(10.0)
        since = running.clock.now
        await running.until(lambda: all(stats.harvests for stats in running.stats.devices.values()), seconds=3600.0)
        assert max(longest_period_s(running, unit.address, since) for unit in units) < live_s + 0.1
        for number, unit in enumerate(units, 1):
            assert stored(tmp_path, f"array-{number}") == truth(unit)
        assert all(stats.waiting_since is None for stats in running.stats.devices.values())


async def test_without_idle_time_it_waits_and_says_so(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    units, gateway = site(tmp_path, live_s_for(1.2))
    async with gateway as running:
        await running.run(LONG_S + 2 * CROWDED_S)
        assert log_reads(running) == []
        waiting = [stats.waiting_since for stats in running.stats.devices.values() if stats.waiting_since is not None]
        assert len(waiting) == 1, "one a line"
        assert running.clock.now - waiting[0] > LONG_S
        (told,) = [record.getMessage() for record in caplog.records if "history_waits" in record.getMessage()]
        assert 'line="shelter-a" device="array-1" waited_s=6' in told
        for unit in units[1:]:
            unit.silent = True  # probes are all that is left of their polls
        await running.until(lambda: running.stats.devices[11].harvests, seconds=3600.0)
        assert running.stats.devices[11].waiting_since is None
        assert stored(tmp_path) == truth(units[0])
