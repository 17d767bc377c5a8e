"""F06: a frame of another unit and the right one arrive in one read."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pytest

from gateway.simulator.medium import Burst, CleanMedium
from tests.faults.pty_rig import running
from tests.faults.rig import MakeRig, frame, read


class Glued(CleanMedium):
    """Frames of others and the right one in one piece, with the right one at `place`."""

    def __init__(self, place: int) -> None:
        self.place = place
        self.on = False

    def reply(self, frame_: bytes, starts_at: float) -> Sequence[Burst]:
        if not self.on:
            return (Burst(starts_at, frame_),)
        others = [frame(200, frame_[1:-2]), frame(201, b"\x03\x02\x12\x34")]
        others.insert(self.place, frame_)
        return (Burst(starts_at, b"".join(others), whole=True),)


@pytest.mark.parametrize("place", [1, 2])
def test_the_right_one_is_found(rig: MakeRig, place: int) -> None:
    medium = Glued(place)
    line = rig(medium=medium)
    medium.on = True
    for first in range(20):
        assert isinstance(line.ask(0, read(first, 4)), bytes)
    assert line.engine.stats.wire.wrong_unit == 20 * place
    assert line.engine.stats.failed.total() == line.engine.stats.failed["exception"]


async def test_over_a_pty(tmp_path: Path) -> None:
    medium = Glued(1)
    async with running(tmp_path, medium=medium) as line:
        await line.online()
        medium.on = True
        for first in range(10):
            assert isinstance(await line.ask(0, read(first, 4)), bytes)
        assert line.line.stats.wire.wrong_unit == 10
