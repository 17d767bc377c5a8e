"""F13: the adapter gives our own requests back (RS-485 local echo)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pytest

from gateway.errors import ReplyTimeout
from gateway.modbus.pdu import read_identification_request
from gateway.simulator.medium import Burst, CleanMedium
from tests.faults.pty_rig import running
from tests.faults.rig import MakeRig, Unit, read


class Echoing(CleanMedium):
    """Every request comes back; `whole`: in one piece, joined with what follows."""

    def __init__(self, *, whole: bool = False) -> None:
        self.whole = whole
        self.on = True

    def echo(self, frame: bytes, started_at: float) -> Sequence[Burst]:
        return (Burst(started_at, frame, whole=self.whole),) if self.on else ()


@pytest.mark.parametrize("whole", [False, True])
@pytest.mark.parametrize("address", [1, 2, 3, 4, 16, 17, 131, 247])
def test_it_works_without_configuration_for_any_address_and_is_shown(rig: MakeRig, address: int, whole: bool) -> None:
    line = rig(Unit(0, address), medium=Echoing(whole=whole))
    for first, count, function in ((0, 1, 3), (0, 82, 3), (0xE000, 80, 4), (0, 256, 1), (3, 17, 2)):
        assert isinstance(line.ask(0, read(first, count, function)), bytes)
    assert isinstance(line.ask(0, read_identification_request()), bytes)
    stats = line.engine.stats
    assert stats.wire.echoes == stats.sent
    assert stats.failed["timeout"] == stats.failed["mismatch"] == 0
    assert line.engine.status(line.now).echo == "present"


def test_a_line_without_echo_says_so(rig: MakeRig) -> None:
    line = rig()
    assert line.engine.status(line.now).echo == "absent"
    line.engine.closed("unplugged", line.now)
    line.engine.opened(line.now)
    assert line.engine.status(line.now).echo == "unknown"


def test_an_echo_alone_is_no_answer(rig: MakeRig) -> None:
    line = rig(medium=Echoing(), retries=0)
    line.units[0].silent = True
    assert isinstance(line.ask(0, read(0, 4)), ReplyTimeout)
    assert line.engine.status(line.now).echo == "present"


async def test_over_a_pty(tmp_path: Path) -> None:
    async with running(tmp_path, medium=Echoing()) as line:
        await line.online()
        for first in range(20):
            assert isinstance(await line.ask(0, read(first, 10)), bytes)
        assert line.line.status(line.clock.monotonic()).echo == "present"
        assert line.line.stats.failed["timeout"] == 0
