"""F01: a reply arrives after its time-out; the next request to the same unit has the same length."""

from __future__ import annotations

from pathlib import Path

import pytest

from gateway.errors import ReplyTimeout
from gateway.simulator.chaos import Chaos, Fault
from tests.faults.pty_rig import running
from tests.faults.rig import MakeRig, read

QUARANTINE_S = 0.1


@pytest.mark.parametrize("late_s", [0.51, 0.53, 0.55, 0.58])
def test_it_is_not_the_answer_and_the_line_waits_until_it_is_over(rig: MakeRig, late_s: float) -> None:
    line = rig(retries=0)
    line.chaos.force(Fault.LATE, for_s=late_s)
    assert isinstance(line.ask(0, read(0)), ReplyTimeout)
    failed_at = line.now
    assert isinstance(line.ask(0, read(10)), bytes)
    assert line.engine.stats.wire.late_bytes == 9
    assert line.engine.stats.wire.mismatch == 0
    next_at = next(at for at, _ in line.sent if at > failed_at - 0.02)
    late_ended = line.sent[-3][0] + line.wire.timing.wire_s(8 + 9) + 0.015 + late_s
    assert next_at >= late_ended + QUARANTINE_S


async def test_over_a_pty(tmp_path: Path) -> None:
    chaos = Chaos(1)
    async with running(tmp_path, medium=chaos, retries=0, reply_timeout_s=0.2) as line:
        await line.online()
        chaos.force(Fault.LATE, for_s=0.23)
        assert isinstance(await line.ask(0, read(0)), ReplyTimeout)
        assert isinstance(await line.ask(0, read(10)), bytes)
        assert line.line.stats.wire.late_bytes == 9
