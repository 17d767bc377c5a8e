"""F16: the USB adapter is unplugged while a transaction is on the wire."""

from __future__ import annotations

import asyncio
import time
from pathlib import Path

import pytest

from gateway.core.site import LineState, Outcome
from gateway.core.snapshot import DeviceState
from gateway.errors import LineDown
from gateway.simulator.chaos import Chaos, Fault
from tests.faults.pty_rig import running
from tests.faults.rig import MakeRig, read
from tests.machine import Stopwatch


def open_files() -> list[str]:
    """What this process holds open of ptys; a file that was removed keeps its name here."""
    targets = []
    for link in Path("/proc/self/fd").iterdir():
        try:
            targets.append(str(link.readlink()))
        except FileNotFoundError:
            continue
    return sorted(target for target in targets if "/pts/" in target or target == "/dev/ptmx")


def test_what_waits_ends_as_0a_and_nothing_is_shown(rig: MakeRig) -> None:
    line = rig()
    outcomes: list[Outcome] = []
    for first in range(5):
        line.read(0, read(0x8000 + 200 * first, 100), outcomes.append)
    line.run(0.05)
    line.engine.closed("unplugged", line.now)
    line.run(0.0)
    assert [type(outcome) for outcome in outcomes] == [LineDown] * 5
    assert {outcome.exception_code for outcome in outcomes if isinstance(outcome, LineDown)} == {0x0A}
    assert line.state() is DeviceState.STALE
    assert not line.devices[0].snapshot.shown()
    assert line.engine.stats.failed["line_down"] == 1


def test_a_reply_to_a_request_from_before_is_nobodys_when_the_port_is_back(rig: MakeRig) -> None:
    """A port that only hiccuped: the device did not notice, and answers late what was asked before."""
    line = rig()
    line.read(0, read(0x8000, 4))
    line.chaos.force(Fault.LATE, for_s=0.4)
    line.run(0.05)
    line.engine.closed("hiccup", line.now)
    line.run(0.1)
    line.engine.opened(line.now)
    for first in range(0, 80, 4):
        line.ask(0, read(first, 4))
    line.run(5.0)
    assert line.state() is DeviceState.ONLINE


async def test_over_a_pty_within_a_second_without_a_busy_loop(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    chaos = Chaos(16)
    before = open_files()
    async with running(tmp_path, medium=chaos, reply_timeout_s=2.0) as line:
        await line.online()
        chaos.on_port_fault = line.unplug_soon
        chaos.force(Fault.UNPLUG, Fault.DROP)
        waiting = [asyncio.ensure_future(line.ask(0, read(0x8000 + n, 100))) for n in (0, 200, 400)]
        watch = Stopwatch()
        outcomes = await asyncio.gather(*waiting)
        assert watch.s < 1.0
        assert [type(outcome) for outcome in outcomes] == [LineDown] * 3
        assert line.line.status(line.clock.monotonic()).state is LineState.DOWN
        assert line.devices[0].snapshot.state is DeviceState.STALE
        await line.until(lambda: open_files() == before)  # both ends of the pty

        cpu, wall = time.process_time(), time.monotonic()
        await asyncio.sleep(1.0)  # the measured second: the port is away and is looked for
        assert (time.process_time() - cpu) / (time.monotonic() - wall) < 0.05
    down = [message for message in caplog.messages if "event=line_down" in message]
    assert 1 <= len(down) <= 2  # why it went down, and why it cannot be opened
    assert "Traceback" not in caplog.text
