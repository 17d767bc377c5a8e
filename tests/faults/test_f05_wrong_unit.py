"""F05: a reply comes from another unit id; the right one follows, or does not."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pytest

from gateway.errors import ReplyTimeout
from gateway.simulator.medium import Burst, CleanMedium
from tests.faults.pty_rig import running
from tests.faults.rig import MakeRig, Unit, frame, read


class Crossed(CleanMedium):
    """The neighbour answers first, from its own address and with its own registers; then, perhaps, the right unit."""

    def __init__(self, neighbour: Unit, *, right_follows: bool = True) -> None:
        self.neighbour = neighbour
        self.right_follows = right_follows
        self.on = False
        self.request_pdu = b""

    def request(self, frame: bytes, ended_at: float) -> bytes:
        self.request_pdu = frame[1:-2]
        return frame

    def reply(self, frame_: bytes, starts_at: float) -> Sequence[Burst]:
        if not self.on:
            return (Burst(starts_at, frame_),)
        wrong = self.neighbour.handle(self.request_pdu, starts_at)
        assert wrong is not None
        bursts = [Burst(starts_at, frame(self.neighbour.address, wrong))]
        return (*bursts, Burst(starts_at + 0.05, frame_)) if self.right_follows else bursts


def test_it_is_ignored_and_the_right_one_fifty_milliseconds_later_is_taken(rig: MakeRig) -> None:
    units = Unit(0), Unit(1)
    medium = Crossed(units[1])
    line = rig(*units, medium=medium)
    medium.on = True
    assert isinstance(line.ask(0, read(0, 4)), bytes)
    assert line.engine.stats.wire.wrong_unit == 1
    assert line.engine.stats.failed["timeout"] == 0


def test_it_does_not_prolong_the_wait_and_is_no_answer(rig: MakeRig) -> None:
    units = Unit(0), Unit(1)
    medium = Crossed(units[1], right_follows=False)
    line = rig(*units, medium=medium, retries=0)
    medium.on = True
    begun = line.now
    assert isinstance(line.ask(0, read(0, 4)), ReplyTimeout)
    assert line.now - begun == pytest.approx(0.5 + line.wire.timing.wire_s(8 + 13), abs=0.02)
    assert line.engine.stats.wire.wrong_unit == 1


async def test_over_a_pty(tmp_path: Path) -> None:
    units = Unit(0), Unit(1)
    medium = Crossed(units[1])
    async with running(tmp_path, *units, medium=medium) as line:
        await line.online()
        medium.on = True
        for first in range(10):
            assert isinstance(await line.ask(0, read(first, 4)), bytes)
        assert line.line.stats.wire.wrong_unit == 10
