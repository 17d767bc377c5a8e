"""F03: a retry while the first reply is still under way; then two replies, and everything one step behind for ever."""

from __future__ import annotations

from pathlib import Path

import pytest

from gateway.simulator.chaos import Chaos, Fault
from tests.faults.pty_rig import running
from tests.faults.rig import MakeRig, read


@pytest.mark.parametrize("retries", [0, 2])
@pytest.mark.parametrize("late_s", [0.45, 0.52, 0.58, 0.6, 0.62, 0.65, 0.7, 0.9, 1.2, 1.9, 2.5, 4.0, 8.0])
def test_two_hundred_reads_back_to_back_after_one_late_reply_give_no_wrong_value(
    rig: MakeRig, late_s: float, retries: int
) -> None:
    line = rig(retries=retries)
    line.chaos.force(Fault.LATE, for_s=late_s)
    for first in range(0x8000, 0x8000 + 4 * 200, 4):  # one length, all different
        line.ask(0, read(first, 4))
    assert line.outcomes["reply"] + line.outcomes["timeout"] + line.outcomes["offline"] == 200
    if late_s < 1.0:
        assert line.outcomes["reply"] >= 200 - (retries == 0)


def test_a_retry_waits_for_the_quarantine_and_the_second_reply_is_nobodys(rig: MakeRig) -> None:
    line = rig(retries=2)
    line.sent.clear()
    line.chaos.force(Fault.LATE, for_s=0.9)
    assert isinstance(line.ask(0, read(0, 4)), bytes)
    (first, _), (second, _) = line.sent[:2]
    assert second >= first + 0.5 + 0.1
    line.run(2.0)
    assert line.engine.stats.wire.late_bytes + 13 * line.engine.stats.wire.mismatch >= 13


async def test_over_a_pty(tmp_path: Path) -> None:
    chaos = Chaos(3)
    async with running(tmp_path, medium=chaos, reply_timeout_s=0.15) as line:
        await line.online()
        chaos.force(Fault.LATE, for_s=0.4)
        replies = 0
        for first in range(0x8000, 0x8000 + 4 * 30, 4):
            replies += isinstance(await line.ask(0, read(first, 4)), bytes)
        assert replies >= 29
