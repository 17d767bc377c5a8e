"""The same as rig.py on a real serial port: the asyncio shell, a pty, chaos and oracle controllers behind it.

The line runs at 115200 baud so that tests are short; nothing sleeps for a fixed time, everything waits for its event.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
from collections.abc import AsyncIterator, Callable, Sequence
from pathlib import Path
from typing import Any

from gateway.clock import SystemClock
from gateway.core.settings import LineSettings
from gateway.core.site import Device, LineState, Outcome
from gateway.core.snapshot import DeviceState
from gateway.devices.plan import poll_plan
from gateway.errors import RequestError
from gateway.lines.serial import SerialLine
from gateway.modbus.pdu import is_exception
from gateway.simulator.chaos import Chaos, Fault
from gateway.simulator.line import SimulatedLine
from gateway.simulator.medium import Medium
from gateway.simulator.oracle import Verdict
from gateway.simulator.pty import PtyLine
from tests.faults.rig import QUIET, Unit, oracle_map

BAUDRATE = 115200


class PtyRig:
    """One line that is served over a pty; `running` opens it."""

    def __init__(self, link: Path, units: Sequence[Unit], medium: Medium, settings: LineSettings) -> None:
        self.units = list(units)
        self.medium = medium
        self.wire = SimulatedLine(units, timing=settings.timing(), medium=medium)
        self.pty = PtyLine(self.wire, link=link)
        self.clock = SystemClock()
        self.devices = [Device(f"array-{n}", 10 + n, unit.address, oracle_map()) for n, unit in enumerate(units, 1)]
        self.line = SerialLine(settings, self.devices, self.clock)

    @property
    def up(self) -> bool:
        """Whether the port is open."""
        return self.line.status(self.clock.monotonic()).state is LineState.OPEN

    @property
    def device_path(self) -> str:
        """The pty itself, behind the link."""
        return os.path.realpath(self.pty.path)

    def unplug_soon(self, _fault: Fault) -> None:
        """Pull the adapter when the simulator is done with the bytes at hand."""
        asyncio.get_running_loop().call_soon(self.pty.unplug)

    async def online(self, limit_s: float = 150.0) -> None:
        """Wait until every device is online and all its blocks are read, so that the line is quiet."""
        blocks = len(poll_plan(oracle_map()))
        await self.until(
            lambda: all(
                device.snapshot.state is DeviceState.ONLINE and len(device.snapshot.blocks) == blocks
                for device in self.devices
            ),
            limit_s=limit_s,
        )

    async def until(self, condition: Callable[[], bool], limit_s: float = 60.0) -> None:
        """Wait for a state that only the line brings about."""
        try:
            async with asyncio.timeout(limit_s):
                while not condition():  # noqa: ASYNC110  # the snapshot is replaced without an event
                    await asyncio.sleep(0.005)
        except TimeoutError as error:
            if isinstance(self.medium, Chaos):
                error.add_note(self.medium.report())
            raise

    async def ask(self, unit: int, pdu: bytes, limit_s: float = 60.0) -> Outcome:
        """Read as a client does; what comes is judged."""
        asked_at = self.clock.monotonic()
        done: asyncio.Future[Outcome] = asyncio.get_running_loop().create_future()
        self.line.read(self.devices[unit], pdu, done.set_result)
        async with asyncio.timeout(limit_s):
            outcome = await done
        self.judge(unit, pdu, outcome, asked_at=asked_at)
        return outcome

    async def write(self, unit: int, pdu: bytes, limit_s: float = 60.0) -> Outcome:
        """Write as a client does."""
        done: asyncio.Future[Outcome] = asyncio.get_running_loop().create_future()
        self.line.write(self.devices[unit], pdu, done.set_result)
        async with asyncio.timeout(limit_s):
            return await done

    def judge(
        self, unit: int, pdu: bytes, outcome: Outcome, *, asked_at: float, max_age_s: float | None = None
    ) -> None:
        """Fail unless a reply is right; errors are not judged."""
        if isinstance(outcome, RequestError) or (is_exception(outcome) and self.units[unit].gave_exceptions):
            return
        verdict = self.units[unit].judge_reply(pdu, outcome, asked_at=asked_at, max_age_s=max_age_s)
        self._check(verdict, f"reply {outcome.hex()} to {pdu.hex()} of unit {unit}")

    def judge_snapshots(self) -> None:
        """Fail unless all blocks and all shown values are right."""
        for unit, device in zip(self.units, self.devices, strict=True):
            snapshot = device.snapshot
            for block in snapshot.blocks:
                verdict = unit.judge(block.space, block.first, block.count, block.data, asked_at=block.read_at)
                self._check(verdict, f"{block} of {device.name}")
            points = {point.name: point for point in device.map.points}
            for name, value in snapshot.shown().items():
                verdict = unit.judge_value(points[name], value, read_at=snapshot.read_at[name])
                self._check(verdict, f"{name} = {value!r} of {device.name}")

    def account(self) -> None:
        """Every transaction is accounted for."""
        stats = self.line.stats
        assert stats.sent - stats.ok - stats.failed.total() in {0, 1}, stats

    def _check(self, verdict: Verdict, what: str) -> None:
        if verdict is not Verdict.RIGHT:
            error = AssertionError(f"{verdict}: {what}")
            if isinstance(self.medium, Chaos):
                error.add_note(self.medium.report())
            raise error


@contextlib.asynccontextmanager
async def running(
    folder: Path, *units: Unit, medium: Medium | None = None, plugged: bool = True, **settings: Any
) -> AsyncIterator[PtyRig]:
    """A pty rig whose line runs; judged and accounted for at the end."""
    settings.setdefault("poll", QUIET)
    link = folder / "ttyUSB0"
    line_settings = LineSettings(name="shelter-a", index=1, port=str(link), baudrate=BAUDRATE, **settings)
    rig = PtyRig(link, units or (Unit(),), medium if medium is not None else Chaos(0), line_settings)
    if plugged:
        rig.pty.open()
    task = asyncio.create_task(rig.line.run())
    try:
        yield rig
        rig.judge_snapshots()
        rig.account()
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task
        rig.pty.close()
