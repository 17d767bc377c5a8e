"""F14: with local echo the echo of a write (05, 06) is byte for byte the reply to a write that succeeded."""

from __future__ import annotations

from pathlib import Path

import pytest

from gateway.errors import DeviceSilent, EchoUnknown, ReplyTimeout
from gateway.simulator.medium import CleanMedium, Medium
from tests.faults.pty_rig import running
from tests.faults.rig import MakeRig, read
from tests.faults.test_f13_echo_on_reads import Echoing

REGISTER = bytes.fromhex("06 E000 1234")
COIL = bytes.fromhex("05 0001 FF00")
BOTH = pytest.mark.parametrize("pdu", [REGISTER, COIL], ids=["06", "05"])


@BOTH
@pytest.mark.parametrize(
    "medium", [CleanMedium(), Echoing(), Echoing(whole=True)], ids=["clean", "echo", "joined echo"]
)
def test_a_write_that_the_device_took_succeeds_once(rig: MakeRig, pdu: bytes, medium: Medium) -> None:
    line = rig(medium=medium, writes=True)
    assert line.write(0, pdu) == pdu
    assert len(line.units[0].writes) == 1
    assert line.engine.stats.writes == 1


@BOTH
def test_an_echo_without_a_device_is_0b_not_success(rig: MakeRig, pdu: bytes) -> None:
    line = rig(medium=Echoing(), writes=True)
    line.units[0].silent = True
    outcome = line.write(0, pdu)
    assert isinstance(outcome, ReplyTimeout)
    assert outcome.exception_code == 0x0B
    assert line.engine.stats.writes == 1  # and never again


@BOTH
def test_writes_wait_until_it_is_known_whether_the_line_echoes(rig: MakeRig, pdu: bytes) -> None:
    line = rig(medium=Echoing(), writes=True, opened_s=0.0)
    outcome = line.write(0, pdu, wait_s=0.02)
    assert isinstance(outcome, EchoUnknown)
    assert outcome.exception_code == 0x06
    assert line.units[0].writes == []


def test_an_exception_behind_the_echo_is_the_answer(rig: MakeRig) -> None:
    line = rig(medium=Echoing(), writes=True)
    line.units[0].exceptions.append(0x04)
    assert line.write(0, REGISTER) == b"\x86\x04"


def test_a_write_that_waits_for_a_missed_reply_is_not_made_when_the_device_stays_silent(rig: MakeRig) -> None:
    """What was never sent is no success, not even for a coil after which silence is one."""
    line = rig(writes=True, retries=0)
    line.units[0].silent = True
    assert isinstance(line.write(0, REGISTER), ReplyTimeout)
    outcome = line.write(0, REGISTER)
    assert isinstance(outcome, DeviceSilent)
    assert not isinstance(outcome, ReplyTimeout)
    assert [pdu for pdu in line.units[0].asked if pdu[0] == 6] == [REGISTER]


@pytest.mark.parametrize("echo", [False, True])
async def test_over_a_pty(tmp_path: Path, echo: bool) -> None:
    async with running(tmp_path, medium=Echoing() if echo else CleanMedium(), writes=True) as line:
        await line.online()
        assert await line.write(0, REGISTER) == REGISTER
        assert isinstance(await line.ask(0, read(0, 10)), bytes)
        line.units[0].silent = True
        assert isinstance(await line.write(0, COIL), ReplyTimeout)
        assert len(line.units[0].writes) == 1
