"""F15: the reply ends early, and silence follows."""

from __future__ import annotations

from pathlib import Path

import pytest

from gateway.errors import ReplyUnusable, RequestError
from gateway.simulator.chaos import Chaos, Fault
from tests.faults.pty_rig import running
from tests.faults.rig import MakeRig, read


@pytest.mark.parametrize("seed", range(12))
def test_it_fails_at_the_deadline_and_the_next_request_is_clean(rig: MakeRig, seed: int) -> None:
    line = rig(retries=0, medium=Chaos(seed))
    begun = line.now
    line.chaos.force(Fault.TRUNCATE)
    outcome = line.ask(0, read(0, 40))
    assert isinstance(outcome, RequestError)
    assert outcome.exception_code == (0x04 if isinstance(outcome, ReplyUnusable) else 0x0B)
    assert line.now - begun == pytest.approx(0.5 + line.wire.timing.wire_s(8 + 85), abs=0.02)
    assert isinstance(line.ask(0, read(0, 40)), bytes)
    assert line.engine.stats.failed.total() - line.engine.stats.failed["exception"] == 1


async def test_over_a_pty(tmp_path: Path) -> None:
    chaos = Chaos(15)
    async with running(tmp_path, medium=chaos, reply_timeout_s=0.3) as line:
        await line.online()
        for n in range(4):
            chaos.force(Fault.TRUNCATE)
            await line.ask(0, read(n, 40))
            assert isinstance(await line.ask(0, read(n, 41)), bytes)
