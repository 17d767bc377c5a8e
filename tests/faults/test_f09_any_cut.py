"""F09: a frame cut into one-byte reads, into batches of 16 ms, or joined: the result is the same."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

from hypothesis import given
from hypothesis import strategies as st

from gateway.core.site import Outcome
from gateway.simulator.chaos import Chaos, Fault
from gateway.simulator.medium import Burst, CleanMedium
from tests.faults.pty_rig import running
from tests.faults.rig import Rig, make_rig, read


class Cut(CleanMedium):
    """Replies in pieces: at these offsets, each piece handed over whole, with pauses between them."""

    def __init__(self, cuts: Sequence[int], pause_s: float, prefix: bytes) -> None:
        self.cuts = sorted(cuts)
        self.pause_s = pause_s
        self.prefix = prefix

    def reply(self, frame: bytes, starts_at: float) -> Sequence[Burst]:
        data = self.prefix + frame
        edges = [0, *(cut for cut in self.cuts if cut < len(data)), len(data)]
        pause_s = min(self.pause_s, 0.4 / len(edges))  # all of it within the time-out
        return [
            Burst(starts_at + n * pause_s, data[first:end], whole=True)
            for n, (first, end) in enumerate(pairwise(edges))
        ]


def outcomes(line: Rig) -> list[Outcome]:
    return [line.ask(0, read(first, count)) for first, count in ((0, 1), (0x10, 9), (0xE000, 40), (0x8F00, 125))]


@given(
    cuts=st.sets(st.integers(1, 260), max_size=30),
    pause_s=st.sampled_from((0.0, 0.0011, 0.004, 0.016)),
    prefix=st.sampled_from((b"", b"\x00", b"\x01\x03", b"\x02\x03\x02\x00\x00\xfc\x44")),
)
def test_every_cut_gives_the_same_replies(cuts: set[int], pause_s: float, prefix: bytes) -> None:
    cut = make_rig(medium=Cut(tuple(cuts), pause_s, prefix), opened_s=8.0)
    whole = make_rig(medium=Cut((), 0.0, prefix), opened_s=8.0)
    assert outcomes(cut) == outcomes(whole)
    for line in (cut, whole):
        line.account()
        assert line.outcomes == {"reply": 4}


async def test_over_a_pty(tmp_path: Path) -> None:
    chaos = Chaos(9)
    async with running(tmp_path, medium=chaos) as line:
        await line.online()
        for n in range(16):
            chaos.force(Fault.SPLIT if n % 2 else Fault.JOIN)
            assert isinstance(await line.ask(0, read(n, 40)), bytes)
        assert line.line.stats.failed["timeout"] == 0
