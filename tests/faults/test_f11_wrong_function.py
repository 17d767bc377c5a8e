"""F11: a reply with a right CRC and the wrong function, or an exception to another function."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import pytest

from gateway.errors import ReplyMismatch
from gateway.modbus.crc import append_crc
from gateway.simulator.chaos import Fault
from gateway.simulator.medium import Burst, CleanMedium
from tests.faults.rig import MakeRig, read

STRANGE: dict[str, Callable[[bytes], bytes]] = {
    "input registers": lambda frame: b"\x04" + frame[2:-2],
    "an exception to another function": lambda _: b"\x84\x02",
    "an exception without a code": lambda _: b"\x83\x00",
    "a write": lambda _: b"\x06\x00\x00\x00\x01",
    "a function nobody knows": lambda frame: b"\x42" + frame[2:-2],
}


class Strange(CleanMedium):
    """Replies turned into something else with a right CRC, while it is on."""

    def __init__(self, turn: Callable[[bytes], bytes]) -> None:
        self.turn = turn
        self.on = False

    def reply(self, frame: bytes, starts_at: float) -> Sequence[Burst]:
        if self.on:
            frame = append_crc(frame[:1] + self.turn(frame))
        return (Burst(starts_at, frame),)


@pytest.mark.parametrize("turn", STRANGE.values(), ids=STRANGE)
def test_it_is_not_taken_counted_as_a_mismatch_and_quarantined(rig: MakeRig, turn: Callable[[bytes], bytes]) -> None:
    medium = Strange(turn)
    line = rig(medium=medium, retries=0)
    medium.on = True
    assert isinstance(line.ask(0, read(0, 4)), ReplyMismatch)
    medium.on = False
    failed_at = line.now
    assert line.engine.stats.wire.mismatch == 1
    assert line.engine.stats.failed["mismatch"] == 1
    assert isinstance(line.ask(0, read(8, 4)), bytes)
    assert next(at for at, _ in line.sent if at > failed_at - 0.02) >= failed_at - 0.02 + 0.1


def test_any_function_that_is_not_ours(rig: MakeRig) -> None:
    line = rig(retries=1)
    for n in range(40):
        line.chaos.force(Fault.WRONG_FUNCTION)
        assert isinstance(line.ask(0, read(n, 4)), bytes)
    assert line.engine.stats.failed["mismatch"] == 40
