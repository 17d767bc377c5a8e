"""F12: a reply whose byte count is not that of the quantity asked for."""

from __future__ import annotations

import pytest

from gateway.errors import ReplyMismatch
from gateway.simulator.chaos import Fault
from tests.faults.rig import MakeRig, read


@pytest.mark.parametrize("function", [1, 2, 3, 4])
def test_it_is_not_taken(rig: MakeRig, function: int) -> None:
    line = rig(retries=0)
    for n in range(15):
        line.chaos.force(Fault.WRONG_COUNT)
        assert isinstance(line.ask(0, read(n, 16 + n, function)), ReplyMismatch)
        line.run(3.0)
        assert isinstance(line.ask(0, read(n, 16 + n, function)), bytes)
    assert line.engine.stats.wire.mismatch == 15


def test_a_second_try_gets_the_right_one(rig: MakeRig) -> None:
    line = rig(retries=1)
    line.chaos.force(Fault.WRONG_COUNT)
    assert isinstance(line.ask(0, read(0, 10)), bytes)
