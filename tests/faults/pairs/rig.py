"""Two controllers on one line, clients and writers before it, and whatever happens; each thing that is told is judged.

What must hold, whatever happens (`Broken` says what did not):

    a reply or a value that is shown was given by the unit that is expected there, no sooner than it claims
    a read after a write that was told to be done gives no older value
    a request ends once, in time, and an exception of a device is one that it gave
    a write goes out once at most and to no other unit; what its client is told, and the ledger, is what became of it
    when all is over, every device is online again with all of its values, and asking for them works
"""

from __future__ import annotations

import heapq
from collections import Counter, deque
from collections.abc import Callable, Generator, Sequence
from dataclasses import replace
from ipaddress import ip_network
from typing import Any

from gateway.core.budget import line_budget
from gateway.core.engine import LineEngine
from gateway.core.identity import Identity
from gateway.core.policy import plan
from gateway.core.requests import Lane, Waiter
from gateway.core.serving import FromMemory, Serving
from gateway.core.settings import LineSettings, PollSettings, UpstreamSettings
from gateway.core.site import Device, LineStatus, Outcome
from gateway.core.snapshot import DeviceState
from gateway.core.stats import LineStats
from gateway.core.write_rules import Range, Requester, WriteRule, WriteRules
from gateway.core.write_wear import Wear, WearLimits
from gateway.core.writing import Job, Moment, Note, Read, Result, perform
from gateway.devices.model import Space
from gateway.devices.schema import load_map
from gateway.errors import RequestError
from gateway.modbus.pdu import ReadRequest, is_exception
from gateway.simulator.line import SimulatedLine
from gateway.simulator.upstream import Habits, SimulatedServer
from tests.core.virtual_line import VirtualLine
from tests.core.virtual_upstream import VirtualUpstream
from tests.faults.pairs.judge import Asked, Judge, Written, is_whole, prostar
from tests.faults.pairs.spoilt import LATE_S, Spoilt
from tests.faults.pairs.witness import START, Witness

TARGET, OTHER, NEWCOMER = 1, 2, 3
"""Addresses: what happens, happens to the first."""
POLL = PollSettings(live_s=2.0, settings_s=300.0)
MAX_AGE_S = 5.0
AWAY_S = 15.0
"""A unit is unplugged for so long at least before another one is in its place: it is missed by then."""
SLICE_S = 0.002
BACK_S = 140.0
"""The longest that a device is away for after all is over: a look a minute, and a question a minute."""
WHOLE_S = 700.0
"""What was refused is asked for again after ten minutes."""
SCADA = Requester("192.0.2.7")
RULE = WriteRule((ip_network("192.0.2.7"),), registers=(Range(0xE000, 0xE04F),))


class Port:
    """The line of devices, as the core knows it."""

    name, index, port, stats = "line", 1, "virtual", LineStats()

    def __init__(self, line: VirtualLine | VirtualUpstream) -> None:
        self.line = line

    def status(self, now: float) -> LineStatus:
        """See `LinePort.status`."""
        return self.line.engine.status(now)

    def read(
        self, device: Device, pdu: bytes, done: Callable[[Outcome], None], *, client: str = "", background: bool = False
    ) -> Waiter:
        """See `LinePort.read`."""
        lane = Lane.BACKGROUND if background else Lane.CLIENT
        return self.line.engine.read(device, pdu, done, self.line.now, client=client, lane=lane)

    def write(self, device: Device, pdu: bytes, done: Callable[[Outcome], None], *, client: str = "") -> Waiter:
        """See `LinePort.write`."""
        return self.line.engine.write(device, pdu, done, self.line.now, client=client)


class PairRig(Judge):
    """See the module. `upstream`: the units are behind a Modbus TCP server."""

    def __init__(self, *, upstream: bool = False, configured: bool = True) -> None:
        super().__init__()
        self.upstream = upstream
        self.configured = configured
        self.wall = 1.7e9
        self.spoilt = Spoilt()
        self.own = {
            address: Witness(
                prostar(),
                device=address - 1,
                address=address,
                serial_number=f"1715034{address}",
                hours=1000.0 * address,
            )
            for address in (TARGET, OTHER, NEWCOMER)
        }
        self.alike = Witness(prostar(), device=3, address=TARGET, serial_number="17150349", hours=5000.0)
        self.other_model = Witness(
            load_map("tristar-mppt"), device=4, address=TARGET, serial_number="99999999", hours=200.0
        )
        self.units = [*self.own.values(), self.alike, self.other_model]
        self.plugged: list[Witness] = list(self.own.values())
        self.server = SimulatedServer(self.plugged, habits=Habits(latency_s=0.02), spoiler=self.spoilt)
        settings = LineSettings("line", 1, "virtual", poll=POLL, writes=True)
        if upstream:
            where = UpstreamSettings("virtual", 502, pipelining=4)
            settings = replace(settings, port="tcp://virtual:502", upstream=where)
        self.settings = settings
        self.wire = SimulatedLine(self.plugged, timing=settings.timing(), medium=self.spoilt, wake_bytes=64)
        self.server.stations = self.wire.stations = self.plugged  # type: ignore[assignment]  # one list for all
        self.deadline_s = line_budget(settings, [prostar()] * 3).reply_deadline_s
        self.serving: dict[int, Serving] = {}
        self.asked: list[Asked] = []
        self.writes: list[Written] = []
        self.outcomes: Counter[str] = Counter()
        self._wear = Wear(WearLimits(per_day=1000, interval_s=0.0))
        self._events: list[tuple[float, int, str, Callable[[], None]]] = []
        self._number = 0
        self._jobs: dict[int, deque[Callable[[], None]]] = {}
        self._running: set[int] = set()
        self._wanted: tuple[int, ...] = (TARGET, OTHER)
        self._away_since = -1e9  # since when the target's place is empty
        self._shut = 0  # who wants the line closed
        self._rebuilding = False
        self.traffic = True
        self.line = self._build((TARGET, OTHER), START)

    # The line

    @property
    def now(self) -> float:
        """The time."""
        return self.line.now

    @property
    def engine(self) -> LineEngine:
        """Of the line as it is configured now."""
        return self.line.engine

    def _build(self, addresses: Sequence[int], now: float) -> VirtualLine | VirtualUpstream:
        self.devices = {
            address: Device(
                f"array-{address}",
                10 + address,
                address,
                prostar(),
                expected=Identity(serial_number=self.own[address].serial_number if self.configured else None),
            )
            for address in addresses
        }
        devices = list(self.devices.values())
        self.line = (
            VirtualUpstream(self.server, devices, self.settings)
            if self.upstream
            else VirtualLine(self.settings, devices, self.wire, now)
        )
        self.line.now = now
        self.line.after_step = self._judge_devices
        port = Port(self.line)
        for device in devices:
            device.line = port
        self.serving = {
            address: Serving(device, max_age_s=MAX_AGE_S, strict_map=False) for address, device in self.devices.items()
        }
        if not self.upstream and not self._shut:
            self.line.engine.opened(now)
        return self.line

    def reset(self) -> None:
        """An upstream's connections break."""
        if isinstance(self.line, VirtualUpstream):
            self.line.reset()

    def close(self, seconds: float, reason: str = "unplugged") -> None:
        """Close the line for so long."""
        self._shut += 1
        if self.upstream:
            self.server.refusing = True
            self.reset()
            self.line.run(0.0)
        elif self._shut == 1:
            self.engine.closed(reason, self.now)
            self.engine.step(self.now)
        self.later(seconds, "open", self._reopen)

    def _reopen(self) -> None:
        self._shut -= 1
        if self._shut:
            return
        self.server.refusing = False
        if not self.upstream:
            self.wire.clear()
            self.engine.opened(self.now)

    def rebuild(self, addresses: Sequence[int] | None, pause_s: float) -> None:
        """Stop the line in order, and have one with these devices (None: the same) after a pause, as a reload does."""
        if addresses is not None:
            self._wanted = tuple(addresses)
        if self._rebuilding:
            return  # what is under way will have them: reloads come one after the other
        self._rebuilding = True
        engine = self.engine
        engine.finish()
        until = self.now + 4.0
        self.line.run(0.0)
        while engine.busy and self.now < until:
            self._pass(SLICE_S)
        self.reset()
        engine.closed("stopped", self.now)
        engine.step(self.now)
        self._shut += 1
        self._judge_devices()
        self._jobs.clear()
        old, self.devices = self.line, {}
        end = self.now + pause_s
        while self._events and self._events[0][0] <= end:
            old.now = max(old.now, self._events[0][0])
            self._happen()
        self._shut -= 1
        self.server.refusing = bool(self._shut)
        self.wire.clear()
        self._build(self._wanted, end)
        engine.step(end)
        self._rebuilding = False

    def place(self, unit: Witness | None) -> None:
        """Have this unit, or none, at the target's address."""
        there = [each for each in self.plugged if each.address != TARGET]
        present = [each for each in self.plugged if each.address == TARGET]
        if unit is None or (present and present != [unit]):
            self._away_since = self.now if present else self._away_since
            self.plugged[:] = there
            if unit is None:
                return
        waits_s = self._away_since + AWAY_S - self.now
        if unit not in present and waits_s > 1e-9:
            self.later(waits_s, "plugged in", lambda: self.place(unit))
            return
        if unit not in present and TARGET in self.devices:
            state = self.devices[TARGET].snapshot.state
            if state is DeviceState.ONLINE:
                raise self.broken(f"a unit that is away for {AWAY_S} s is {state}")
        self.plugged[:] = [*there, unit]

    # Time

    def later(self, seconds: float, what: str, act: Callable[[], None]) -> None:
        """Do that after so many seconds of being awake."""
        self._number += 1
        heapq.heappush(self._events, (self.now + seconds, self._number, what, act))

    def sleep(self, seconds: float) -> None:
        """The machine sleeps; the world goes on, but for what is to happen to us."""
        self._events = [(at + seconds, *rest) for at, *rest in self._events]  # type: ignore[misc]  # the same four
        for asked in self.asked:
            asked.by += seconds
        if self._away_since > 0:
            self._away_since += seconds
        self.line.now += seconds

    def run(self, seconds: float) -> None:
        """Let time pass, with what was to happen in it."""
        end = self.now + seconds
        while True:
            at = min(end, self._events[0][0]) if self._events else end
            if at > self.now:
                self._pass(at - self.now)
            if not self._events or self._events[0][0] > end:
                return
            began = self.now
            self._happen()
            end += max(0.0, self.now - began)

    def until(self, condition: Callable[[], bool], within_s: float, step_s: float = SLICE_S) -> bool:
        """Let time pass until that holds; whether it did in time."""
        end = self.now + within_s
        while not condition():
            if self.now >= end:
                return False
            self.run(step_s)
        return True

    @property
    def pending(self) -> bool:
        """Whether something is still to happen."""
        return bool(self._events)

    def _happen(self) -> None:
        at, _, what, act = heapq.heappop(self._events)
        self.line.now = max(self.line.now, at)
        self.story.append(f"{self.now:.3f} {what}")
        act()

    def _pass(self, seconds: float) -> None:
        self.line.run(seconds)
        self._judge_devices()
        if self._broken is not None:
            raise self._broken
        for asked in self.asked:
            if asked.outcome is None and asked.by < self.now:
                raise self.broken(f"{asked.what} has no end")
        if len(self.asked) > 64:
            self.asked = [asked for asked in self.asked if asked.outcome is None]

    # Requests

    def read(self, address: int, first: int, count: int, client: str = "a", function: int = 3) -> Asked:
        """Ask as a Modbus TCP client does."""
        asked_at = self.now
        asked = Asked(f"read of {first:#06x}+{count} of {address} asked at {asked_at:.3f}", asked_at + self.deadline_s)
        device = self.devices.get(address)
        if device is None:
            asked.outcome = b""
            return asked
        serving = self.serving[address]
        pdu = ReadRequest(function, first, count).encode()
        self.asked.append(asked)
        try:
            answer = serving.answer(pdu, asked_at)
        except RequestError as error:
            self._end(asked, error)
            return asked
        if isinstance(answer, FromMemory):
            self._judge_reply(address, pdu, answer.reply, asked, since=asked_at - MAX_AGE_S, told=dict(self._told_at))
            self._end(asked, answer.reply)
            return asked
        ask = answer
        told = dict(self._told_at)

        def done(outcome: Outcome) -> None:
            serving.learn(ask, outcome)
            self._judge_reply(address, pdu, outcome, asked, since=asked_at, told=told)
            self._end(asked, outcome)

        device.line.read(device, pdu, done, client=client)
        return asked

    def write(self, address: int = TARGET, register: int = 0xE000) -> Written | None:
        """Write as an allowed client does: noted, compared, written once, read back."""
        device = self.devices.get(address)
        if device is None:
            return None
        value = 0x4A01 + len(self.writes)
        by = self.now + 6 * self.deadline_s
        asked = Asked(f"write of {value:#06x} to {register:#06x} of {address} asked at {self.now:.3f}", by)
        self.asked.append(asked)
        written = Written(address, register, value, asked)
        self.writes.append(written)
        pdu = bytes([6]) + register.to_bytes(2) + value.to_bytes(2)
        job = plan(pdu, WriteRules([RULE], device), SCADA, f"{len(self.writes)}")
        assert isinstance(job, Job)
        serving = self.serving[address]

        def begin() -> None:
            self._running.add(id(device))
            self._step(device, perform(job, self._wear, self._moment()), written, serving, None)

        if id(device) in self._running:
            self._jobs.setdefault(id(device), deque()).append(begin)
        else:
            begin()
        return written

    def write_raw(self, address: int = TARGET, register: int = 0xE00A) -> Written | None:
        """Have the line make a single write."""
        device = self.devices.get(address)
        if device is None:
            return None
        value = 0x4A01 + len(self.writes)
        asked = Asked(f"single write of {value:#06x} to {address} asked at {self.now:.3f}", self.now + self.deadline_s)
        self.asked.append(asked)
        written = Written(address, register, value, asked)
        self.writes.append(written)
        serving = self.serving[address]

        def done(outcome: Outcome) -> None:
            serving.forget(Space.REGISTERS, register)
            self._written(written, outcome)

        device.line.write(device, bytes([6]) + register.to_bytes(2) + value.to_bytes(2), done)
        return written

    def _step(
        self,
        device: Device,
        steps: Generator[Any, Moment, Result],
        written: Written,
        serving: Serving,
        moment: Moment | None,
    ) -> None:
        """As faces/modbus/writer.py."""
        try:
            step = next(steps) if moment is None else steps.send(moment)
            while isinstance(step, Note):
                step = steps.send(self._moment())
        except StopIteration as stop:
            result: Result = stop.value
            written.fate = result.parts[0].fate
            self._written(written, result.outcome)
            self._running.discard(id(device))
            jobs = self._jobs.get(id(device))
            if jobs:
                jobs.popleft()()
            return
        if isinstance(step, Read):
            device.line.read(
                device, step.pdu, lambda o: self._step(device, steps, written, serving, self._moment(o)), client="w"
            )
            return
        write = step.write

        def done(outcome: Outcome) -> None:
            serving.forget(write.space, write.address)
            self._step(device, steps, written, serving, self._moment(outcome))

        device.line.write(device, write.encode(), done, client="w")

    def _moment(self, outcome: Outcome = b"") -> Moment:
        return Moment(self.now, self.wall, outcome)

    def _end(self, asked: Asked, outcome: Outcome) -> None:
        if asked.outcome is not None:
            raise self.broken(f"{asked.what} ended twice: {asked.outcome!r}, {outcome!r}")
        asked.outcome = outcome
        label = outcome.label if isinstance(outcome, RequestError) else "reply"
        self.outcomes[
            f"exception_{outcome[1]:02x}" if isinstance(outcome, bytes) and is_exception(outcome) else label
        ] += 1

    def _written(self, written: Written, outcome: Outcome) -> None:
        self._end(written.asked, outcome)
        self._judge_write(written)
        for at, register, value in self.own[written.address].told:
            if value == written.value and isinstance(outcome, bytes) and not is_exception(outcome):
                self._told_at[written.address, register] = at

    # The end

    def healthy(self) -> bool:
        """Whether all devices are online, and fresh."""
        for device in self.devices.values():
            snapshot = device.snapshot
            if snapshot.state is not DeviceState.ONLINE or snapshot.warnings:
                return False
            live = [block for block in snapshot.blocks if block.first < 0x100]
            if not live or any(block.read_at < self.now - 3 * POLL.live_s for block in live):
                return False
        return True

    def is_whole(self) -> bool:
        """Whether nothing that is polled is missing."""
        return all(is_whole(device) for device in self.devices.values())

    def recover(self) -> None:
        """All is over: everything has to be as before."""
        while self.pending:
            self.run(max(0.0, self._events[0][0] - self.now))
        self.spoilt.fates.clear()
        over = self.now
        self.run(max(LATE_S.values()) + 2.0)  # what is under way may be lost already
        if not self.until(self.healthy, BACK_S, 0.25):
            raise self.broken(f"not online and fresh {BACK_S} s after all is over: {self._state()}")
        slow = not self.upstream  # else ten minutes of polls of single registers take long to go through
        if slow and not self.is_whole() and not self.until(self.is_whole, WHOLE_S, 1.0):
            raise self.broken(f"not all is read {WHOLE_S} s after all is over: {self._state()}")
        self._ask_once_more()
        for one in self.writes:
            self._judge_write(one)
        stats = self.engine.stats
        if not 0 <= stats.sent - stats.ok - stats.failed.total() <= 4:
            raise self.broken(f"not accounted for: {stats}")
        self.story.append(f"{self.now:.3f} recovered within {self.now - over:.1f} s")

    def _ask_once_more(self) -> None:
        asked = [self.read(address, 0x8000, 2) for address in self.devices]
        self.run(3 * POLL.live_s + 1.0)
        written = self.write()
        assert written is not None
        self.until(lambda: all(each.outcome is not None for each in self.asked), 6 * self.deadline_s, 0.25)
        for each in (*asked, written.asked):
            if not isinstance(each.outcome, bytes) or is_exception(each.outcome):
                raise self.broken(f"{each.what}, all is over: {each.outcome!r}")
        if not self.healthy():
            raise self.broken(f"not online and fresh any more: {self._state()}")

    def _state(self) -> str:
        return ", ".join(
            f"{device.name} {device.snapshot.state} {sorted(device.snapshot.warnings)}"
            for device in self.devices.values()
        )
