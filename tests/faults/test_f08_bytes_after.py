"""F08: bytes after the frame, in the same read or a moment later."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pytest

from gateway.simulator.medium import Burst, CleanMedium
from tests.faults.pty_rig import running
from tests.faults.rig import MakeRig, read


class Trailing(CleanMedium):
    """`tail` after every reply, `after_s` after its end; None of it at first."""

    def __init__(self, after_s: float) -> None:
        self.after_s = after_s
        self.tail = b""

    def reply(self, frame_: bytes, starts_at: float) -> Sequence[Burst]:
        if not self.tail:
            return (Burst(starts_at, frame_),)
        ends_at = starts_at + len(frame_) * 11 / 9600
        return (Burst(starts_at, frame_), Burst(ends_at + self.after_s, self.tail))


@pytest.mark.parametrize("after_s", [0.0, 0.002, 0.02])
@pytest.mark.parametrize("tail", [b"\x00", b"\x01\x03", b"\x01\x03\x08\x11\x22\x33", bytes(40)], ids=lambda t: t.hex())
def test_they_start_no_phantom_and_the_next_request_waits_for_silence(
    rig: MakeRig, tail: bytes, after_s: float
) -> None:
    medium = Trailing(after_s)
    line = rig(medium=medium, wake_bytes=1)
    medium.tail = tail
    for first in range(30):
        assert isinstance(line.ask(0, read(first, 4)), bytes)
        line.run(0.05 if after_s else 0.0)
    wire = line.engine.stats.wire
    assert wire.late_bytes + wire.noise_bytes >= 29 * len(tail)
    assert line.engine.stats.failed.total() == line.engine.stats.failed["exception"]
    if after_s < line.wire.timing.gap_s:
        assert line.wire.counters.collisions == 0
        assert line.wire.counters.gap_violations == 0


async def test_over_a_pty(tmp_path: Path) -> None:
    medium = Trailing(0.0)
    async with running(tmp_path, medium=medium) as line:
        await line.online()
        medium.tail = b"\x01\x03\x08\x11\x22"
        for first in range(20):
            assert isinstance(await line.ask(0, read(first, 4)), bytes)
