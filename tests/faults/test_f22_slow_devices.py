"""F22: devices that need a pause between frames, and devices that are slow to answer."""

from __future__ import annotations

from pathlib import Path

import pytest

from gateway.core.settings import PollSettings
from gateway.errors import ReplyTimeout
from gateway.modbus.rtu import Timing
from tests.faults.pty_rig import running
from tests.faults.rig import MakeRig, Unit, read

BUSY = PollSettings(live_s=0.2, settings_s=1.0)


@pytest.mark.parametrize("gap_s", [0.0, 0.002, 0.01, 0.1])
@pytest.mark.parametrize("baudrate", [1200, 9600, 19200, 38400])
def test_the_gap_on_the_wire_is_never_shorter_than_configured_nor_than_3_5_characters(
    rig: MakeRig, baudrate: int, gap_s: float
) -> None:
    least = Timing.of(baudrate, 8, "N", 2).gap_s
    units = [Unit(n, turnaround_s=0.0) for n in range(3)]
    line = rig(
        *units, opened_s=30.0 if baudrate > 2000 else 90.0, wake_bytes=1, baudrate=baudrate, gap_s=gap_s, poll=BUSY
    )
    counters = line.wire.counters
    assert counters.requests > 50
    assert counters.gap_violations == counters.collisions == 0
    assert counters.shortest_gap_s >= max(least, gap_s) - 1e-6
    assert counters.shortest_gap_s < max(least, gap_s) + 0.002  # and not much longer


def test_a_slow_device_has_its_own_time_out_and_the_others_keep_theirs(rig: MakeRig) -> None:
    slow, quick = Unit(0, turnaround_s=1.5), Unit(1)
    line = rig(slow, quick, opened_s=0.0, retries=0)
    line.devices[0].reply_timeout_s = 2.0
    line.run(20.0)
    assert isinstance(line.ask(0, read(0, 4)), bytes)
    quick.silent = True
    begun = line.now
    assert isinstance(line.ask(1, read(0, 4)), ReplyTimeout)
    assert line.now - begun < 0.6
    quick.silent = False
    assert isinstance(line.ask(1, read(0, 4)), bytes)


def test_a_device_slower_than_its_time_out_never_gives_a_wrong_value(rig: MakeRig) -> None:
    """Every one of its replies comes after the wait for it."""
    line = rig(Unit(0, turnaround_s=0.8), Unit(1), opened_s=60.0, poll=BUSY)
    for first in range(40):
        line.ask(0, read(first, 4))
        line.ask(1, read(first, 4))
    assert line.engine.stats.wire.late_bytes + line.engine.stats.wire.mismatch > 0
    assert line.outcomes["reply"] >= 40


async def test_over_a_pty(tmp_path: Path) -> None:
    async with running(tmp_path, Unit(0), Unit(1, turnaround_s=0.3), gap_s=0.02, reply_timeout_s=0.1) as line:
        line.devices[1].reply_timeout_s = 1.0
        await line.online()
        for first in range(5):
            for unit in range(2):
                assert isinstance(await line.ask(unit, read(first, 20)), bytes)
        # What the wire saw, as exactly as the machine lets a pty see it: a request is never early.
        assert line.wire.counters.shortest_gap_s >= 0.02 - 0.001
