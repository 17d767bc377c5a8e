"""F10: a reply with a wrong CRC."""

from __future__ import annotations

from pathlib import Path

import pytest

from gateway.errors import ReplyCrcError
from gateway.simulator.chaos import Chaos, Fault
from tests.faults.pty_rig import running
from tests.faults.rig import MakeRig, read


@pytest.mark.parametrize("hits", [1, 2])
def test_a_read_is_tried_again_and_the_damaged_reply_is_never_delivered(rig: MakeRig, hits: int) -> None:
    line = rig(retries=2, medium=Chaos(hits))
    begun = line.now
    for _ in range(hits):
        line.chaos.force(Fault.BIT_FLIP)
    assert isinstance(line.ask(0, read(0, 20)), bytes)
    assert line.engine.stats.wire.crc_errors == hits
    assert line.engine.stats.failed["crc"] == hits
    assert line.now - begun < 0.6 * (hits + 1)


@pytest.mark.parametrize("retries", [0, 1, 3])
def test_after_the_retries_it_is_04(rig: MakeRig, retries: int) -> None:
    line = rig(retries=retries)
    before = line.engine.stats.sent
    for _ in range(40):
        line.chaos.force(Fault.BIT_FLIP)
    outcome = line.ask(0, read(0, 20))
    assert isinstance(outcome, ReplyCrcError)
    assert outcome.exception_code == 0x04
    assert line.engine.stats.sent == before + retries + 1
    assert line.engine.stats.wire.crc_errors == retries + 1


def test_whichever_bit_is_hit(rig: MakeRig) -> None:
    line = rig(retries=0)
    for seed in range(60):
        line.chaos.force(Fault.BIT_FLIP)
        assert isinstance(line.ask(0, read(seed % 40, 4)), ReplyCrcError)
        line.run(0.2)
        assert isinstance(line.ask(0, read(seed % 40, 4)), bytes)


async def test_over_a_pty(tmp_path: Path) -> None:
    chaos = Chaos(10)
    async with running(tmp_path, medium=chaos) as line:
        await line.online()
        for n in range(5):
            chaos.force(Fault.BIT_FLIP)
            assert isinstance(await line.ask(0, read(n, 40)), bytes)
        assert line.line.stats.wire.crc_errors >= 5
