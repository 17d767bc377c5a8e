"""F04: the client disconnects, or is cancelled, while its request is on the wire."""

from __future__ import annotations

import pytest

from gateway.core.site import Outcome
from tests.faults.rig import MakeRig, read


def test_the_transaction_runs_to_its_end_and_the_next_is_right(rig: MakeRig) -> None:
    line = rig()
    before = line.engine.stats.ok
    gone = line.read(0, read(0, 4), lambda _: pytest.fail("it has left"))
    line.run(0.005)  # on the wire now
    kept: list[Outcome] = []
    gone.cancel(kept.append)
    gone.cancel()  # once more changes nothing
    assert isinstance(line.ask(0, read(8, 4)), bytes)
    assert len(kept) == 1
    assert isinstance(kept[0], bytes)
    assert line.engine.stats.ok == before + 2
    assert line.engine.stats.failed["timeout"] == 0


def test_one_who_leaves_takes_nothing_from_another(rig: MakeRig) -> None:
    line = rig()
    outcomes: list[object] = []
    gone = line.read(0, read(0, 4), lambda _: pytest.fail("it has left"))
    line.read(0, read(0, 4), outcomes.append)
    line.run(0.005)
    gone.cancel()
    line.run(1.0)
    assert len(outcomes) == 1
    assert isinstance(outcomes[0], bytes)


def test_what_nobody_waits_for_any_more_costs_no_line_time(rig: MakeRig) -> None:
    line = rig()
    line.read(0, read(0x8000, 100))
    waiting = line.read(0, read(0x8100, 100), lambda _: pytest.fail("it has left"))
    line.run(0.005)
    sent = line.engine.stats.sent
    waiting.cancel(lambda _: pytest.fail("it was never made"))
    line.run(2.0)
    assert line.engine.stats.sent == sent
