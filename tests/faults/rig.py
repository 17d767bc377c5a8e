"""A line engine, oracle controllers and chaos between them, on one virtual clock; every reply is judged.

No test states what a register should hold: whatever comes out of the engine (replies to reads, blocks and values
of the snapshots) goes to the oracle at once, and any verdict but "right" fails the test with the seed and the wire.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from random import Random
from typing import Any

from gateway.core.engine import LineEngine
from gateway.core.requests import Lane, Waiter
from gateway.core.settings import LineSettings, PollSettings
from gateway.core.site import Device, Outcome
from gateway.core.snapshot import DeviceState
from gateway.devices.model import DeviceMap
from gateway.devices.schema import load_map
from gateway.errors import RequestError
from gateway.modbus.crc import append_crc
from gateway.modbus.pdu import Function, ReadRequest, is_exception
from gateway.simulator.chaos import Chaos, Fault
from gateway.simulator.line import SimulatedLine
from gateway.simulator.medium import Medium
from gateway.simulator.oracle import OracleController, Verdict
from tests.core.virtual_line import end_of
from tests.faults.judge import Judge

QUIET = PollSettings(live_s=3600.0, settings_s=3600.0)
"""Polls only at the start, so that a test has the line to itself."""

CLOSED_S = 0.3
UNPLUGGED_S = 4.0


@cache
def oracle_map() -> DeviceMap:
    """The ProStar without growing counters: an oracle's hourmeter jumps with every answer."""
    device_map = load_map("prostar-mppt")
    return replace(device_map, identity=replace(device_map.identity, growing=()))


def read(first: int = 0, count: int = 2, function: int = Function.READ_HOLDING_REGISTERS) -> bytes:
    """A read request PDU."""
    return ReadRequest(function, first, count).encode()


def frame(address: int, pdu: bytes) -> bytes:
    """A frame with a right CRC."""
    return append_crc(bytes([address]) + pdu)


class Unit(OracleController):
    """An oracle that can also answer exceptions; `exceptions` are codes for the next answers."""

    def __init__(self, device: int = 0, address: int | None = None, turnaround_s: float = 0.015) -> None:
        super().__init__(
            oracle_map(),
            device=device,
            address=device + 1 if address is None else address,
            turnaround_s=turnaround_s,
            sequenced=True,
        )
        self.asked: list[bytes] = []
        self.exceptions: deque[int] = deque()
        self.gave_exceptions = 0

    def handle(self, pdu: bytes, now: float) -> bytes | None:
        """See `Controller.handle`."""
        self.asked.append(pdu)
        if self.exceptions and not self.silent:
            self.gave_exceptions += 1
            return bytes((pdu[0] | 0x80, self.exceptions.popleft()))
        return super().handle(pdu, now)


class Rig:
    """See the module; `run` lets time pass."""

    def __init__(self, units: Sequence[Unit], medium: Medium, settings: LineSettings, *, wake_bytes: int = 16) -> None:
        self.now = start = 1000.0
        self.units = list(units)
        self.wire = SimulatedLine(units, timing=settings.timing(), medium=medium, wake_bytes=wake_bytes)
        self.chaos = medium if isinstance(medium, Chaos) else Chaos(0)
        self.devices = [Device(f"array-{n}", 10 + n, unit.address, oracle_map()) for n, unit in enumerate(units, 1)]
        self.engine = LineEngine(settings, self.devices, start, Random(1))
        self.sent: list[tuple[float, bytes]] = []
        self.verdicts: Counter[Verdict] = Counter()
        self.outcomes: Counter[str] = Counter()
        self._wrong: AssertionError | None = None  # the first; raised by `run`, for the engine survives its callers
        self._judge_of = Judge(self.units, self.devices, self._count)
        self._reopen_at = math.inf
        if isinstance(medium, Chaos):
            medium.on_port_fault = self._port_fault
        self.engine.opened(start)

    def run(self, seconds: float) -> None:
        """Let `seconds` pass."""
        end = self.now + seconds
        engine, wire = self.engine, self.wire
        while True:
            out = engine.step(self.now)
            if out is not None:
                self.sent.append((self.now, out))
                wire.receive(out, self.now)
            moments = (engine.next_deadline(self.now), wire.next_event(), self._reopen_at)
            moment = min(moment for moment in moments if moment is not None)
            if moment > end:
                self.now = end
                return
            self.now = max(self.now, moment)
            data = wire.take(self.now)
            if data:
                engine.receive(data, self.now)
            engine.on_timer(self.now)
            self._judge_of.blocks()
            self._raise_wrong()
            if self._reopen_at <= self.now:
                self._reopen_at = math.inf
                wire.clear()
                engine.opened(self.now)

    def read(
        self,
        unit: int,
        pdu: bytes,
        done: Callable[[Outcome], None] | None = None,
        *,
        client: str = "",
        lane: Lane = Lane.CLIENT,
    ) -> Waiter:
        """Read of the unit with that index, as a client does; the outcome is judged before `done` gets it."""
        asked_at = self.now

        def judged(outcome: Outcome) -> None:
            self._judge(unit, pdu, outcome, asked_at)
            if done is not None:
                done(outcome)

        return self.engine.read(self.devices[unit], pdu, judged, self.now, client=client, lane=lane)

    def ask(self, unit: int, pdu: bytes, wait_s: float = 30.0) -> Outcome:
        """Read and wait for the outcome."""
        outcomes: list[Outcome] = []
        self.read(unit, pdu, outcomes.append)
        return end_of(outcomes, self, wait_s)

    def write(self, unit: int, pdu: bytes, wait_s: float = 30.0) -> Outcome:
        """Write and wait for the outcome."""
        outcomes: list[Outcome] = []
        self.engine.write(self.devices[unit], pdu, outcomes.append, self.now, client="")
        return end_of(outcomes, self, wait_s)

    def state(self, unit: int = 0) -> DeviceState:
        """The device's state."""
        return self.devices[unit].snapshot.state

    def account(self) -> None:
        """Every transaction is accounted for, and nothing that was shown is wrong."""
        stats = self.engine.stats
        on_wire = stats.sent - stats.ok - stats.failed.total()
        assert on_wire in {0, 1}, stats
        known = {"timeout", "crc", "mismatch", "exception", "line_down"}
        assert set(stats.failed) <= known, stats.failed
        self.judge_values()
        self._raise_wrong()

    def judge_values(self) -> None:
        """Decoded values that a face would show now."""
        self._judge_of.values()

    def _raise_wrong(self) -> None:
        if self._wrong is not None:
            raise self._wrong

    def _judge(self, index: int, pdu: bytes, outcome: Outcome, asked_at: float) -> None:
        unit = self.units[index]
        if isinstance(outcome, RequestError):
            self.outcomes[outcome.label] += 1
            return
        self.outcomes["exception" if is_exception(outcome) else "reply"] += 1
        if is_exception(outcome) and unit.gave_exceptions:
            return
        verdict = unit.judge_reply(pdu, outcome, asked_at=asked_at)
        self._count(verdict, f"reply {outcome.hex()} to {pdu.hex()} of unit {unit.address}, asked at {asked_at:.4f}")

    def _count(self, verdict: Verdict, what: str) -> None:
        self.verdicts[verdict] += 1
        if verdict is not Verdict.RIGHT and self._wrong is None:
            self._wrong = AssertionError(f"{verdict} at {self.now:.4f}: {what}")
            self._wrong.add_note(self.chaos.report())

    def _port_fault(self, fault: Fault) -> None:
        if self._reopen_at == math.inf:
            self.engine.closed(str(fault), self.now)
            self._reopen_at = self.now + (CLOSED_S if fault is Fault.CLOSE else UNPLUGGED_S)


def make_rig(
    *units: Unit, medium: Medium | None = None, opened_s: float = 3.0, wake_bytes: int = 16, **settings: Any
) -> Rig:
    """A rig with these units (one, when none is given), opened and polled once; then it is quiet.

    `settings` are those of LineSettings; without `poll` nothing is polled after the start. `wake_bytes` is how many
    bytes the client's adapter gathers before it hands them over.
    """
    settings.setdefault("poll", QUIET)
    line_settings = LineSettings(name="line", index=1, port="virtual", **settings)
    rig = Rig(units or (Unit(),), medium if medium is not None else Chaos(0), line_settings, wake_bytes=wake_bytes)
    rig.run(opened_s)
    return rig


MakeRig = Callable[..., Rig]
