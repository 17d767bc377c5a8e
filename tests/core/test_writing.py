"""How a write is done: the steps asked for, in their order, against a simulated controller."""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass, field, replace
from ipaddress import ip_network

import pytest

from gateway.core.policy import Reason, Refusal, plan
from gateway.core.site import Device, LineState, LineStatus, Outcome, Ticket
from gateway.core.snapshot import Block, DeviceState, Snapshot
from gateway.core.stats import LineStats
from gateway.core.write_ledger import Fate, Intent, Record, Verdict
from gateway.core.write_rules import Range, Requester, WriteRule, WriteRules
from gateway.core.write_wear import Wear, WearLimits
from gateway.core.writing import Job, Moment, Note, Read, Result, SlaveControl, Step, Write, perform, settle
from gateway.devices.model import Space
from gateway.devices.schema import load_map
from gateway.errors import (
    DeviceOffline,
    EchoUnknown,
    IllegalDataValue,
    IllegalFunction,
    LedgerUnavailable,
    LineDown,
    QueueFull,
    ReplyCrcError,
    ReplyTimeout,
    ShuttingDown,
    Unconfirmed,
    WriteBudgetSpent,
    WriteDiffers,
    WriteTooSoon,
)
from gateway.simulator.device import SimulatedController

MAP = load_map("prostar-mppt")
SCADA = Requester("192.0.2.7")
EVERYTHING = (Range(0, 0xFFFF),)
NAMED = frozenset(point.name for point in MAP.points if point.named_only)
RULE = WriteRule((ip_network("192.0.2.7"),), registers=EVERYTHING, coils=EVERYTHING, points=NAMED)
VOLTAGE = 0xE000


@dataclass(eq=False)
class Line:
    """Only the state; the steps are answered by the test."""

    state: LineState = LineState.OPEN
    name: str = "shelter-a"
    index: int = 1
    port: str = "virtual"
    stats: LineStats = field(default_factory=LineStats)

    def status(self, now: float) -> LineStatus:
        return LineStatus(self.state, now, "", 0, 0.0)

    def read(
        self, device: Device, pdu: bytes, done: Callable[[Outcome], None], *, client: str = "", background: bool = False
    ) -> Ticket:
        raise AssertionError("a procedure asks by its steps")

    def write(self, device: Device, pdu: bytes, done: Callable[[Outcome], None], *, client: str = "") -> Ticket:
        raise AssertionError("a procedure asks by its steps")


class Bench:
    """A simulated controller behind a line, and what was asked of both and of the ledger."""

    def __init__(self) -> None:
        self.line = Line()
        self.device = Device("array-1", 11, 1, MAP, snapshot=Snapshot(state=DeviceState.ONLINE))
        self.device.line = self.line
        self.unit = SimulatedController(MAP, address=1)
        self.wear = Wear(WearLimits(per_day=3, interval_s=1.0))
        self.slave = SlaveControl()
        self.now = 1000.0
        self.steps: list[Step] = []
        self.records: list[Record] = []
        self.faults: dict[int, Outcome] = {}  # by the number of the line's transaction, from 0
        self.disk_full = False
        self._asked = 0

    def job(self, pdu: str, id_: str = "job") -> Job:
        planned = plan(bytes.fromhex(pdu), WriteRules([RULE], self.device), SCADA, id_)
        assert isinstance(planned, Job)
        return planned

    def write(self, pdu: str, id_: str = "job") -> Result:
        job = self.job(pdu, id_)
        self.steps.clear()
        self._asked = 0
        return self.drive(perform(job, self.wear, Moment(self.now, self.now)))

    def control(self, pdu: str, id_: str = "job") -> Result:
        self.steps.clear()
        self._asked = 0
        return self.drive(self.slave.perform(self.job(pdu, id_), Moment(self.now, self.now)))

    def settle(self, *intents: Intent) -> tuple[str, ...]:
        self.steps.clear()
        self._asked = 0
        steps = settle(intents, self.device)
        try:
            step = next(steps)
            while True:
                step = steps.send(Moment(self.now, self.now, self.answer(step)))
        except StopIteration as stop:
            ids: tuple[str, ...] = stop.value
            return ids

    def drive(self, steps: Generator[Step, Moment, Result]) -> Result:
        try:
            step = next(steps)
            while True:
                step = steps.send(Moment(self.now, self.now, self.answer(step)))
        except StopIteration as stop:
            result: Result = stop.value
            return result

    def answer(self, step: Step) -> Outcome:
        self.steps.append(step)
        if isinstance(step, Note):
            if self.disk_full:
                return LedgerUnavailable()
            self.records += step.records
            return b""
        fault = self.faults.get(self._asked)
        self._asked += 1
        if fault is not None:
            return fault
        reply = self.unit.handle(step.pdu if isinstance(step, Read) else step.write.encode(), self.now)
        if reply is None:
            return step.write.encode() if isinstance(step, Write) else ReplyTimeout()
        return reply

    def kinds(self) -> list[str]:
        return [type(step).__name__ for step in self.steps]

    def fates(self) -> list[Fate]:
        return [record.fate for record in self.records if isinstance(record, Verdict)]

    def holds(self, address: int) -> int:
        return self.unit.read(Space.REGISTERS, address, 1, self.now)[0]


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_an_eeprom_register_is_compared_noted_written_and_read_back(bench: Bench) -> None:
    old = bench.holds(VOLTAGE)
    result = bench.write("06 E000 4B64")
    assert result.outcome == bytes.fromhex("06 E000 4B64")
    assert bench.kinds() == ["Read", "Note", "Write", "Read", "Note"]
    assert bench.steps[1] == Note(bench.steps[1].records, before=True)  # type: ignore[union-attr]  # a Note by its kind
    intent, verdict = bench.records
    assert isinstance(intent, Intent)
    assert (intent.peer, intent.unit_id, intent.point, intent.old, intent.new, intent.wears) == (
        *("192.0.2.7", 11, "absorption_voltage", old, 0x4B64),
        True,
    )
    assert verdict == Verdict(intent.id, 1000.0, Fate.WRITTEN, found=0x4B64)
    assert bench.holds(VOLTAGE) == 0x4B64
    assert [part.fate for part in result.parts] == [Fate.WRITTEN]


def test_what_an_eeprom_register_holds_already_is_not_written(bench: Bench) -> None:
    bench.write("06 E000 4B64")
    bench.records.clear()
    result = bench.write("06 E000 4B64")  # at the same moment: no limit either
    assert result.outcome == bytes.fromhex("06 E000 4B64")
    assert bench.kinds() == ["Read"]
    assert not bench.records
    assert [part.fate for part in result.parts] == [Fate.UNCHANGED]


def test_several_are_written_one_by_one_in_order_and_equal_ones_left_out(bench: Bench) -> None:
    bench.write("06 E003 1388")
    bench.records.clear()
    bench.now += 5
    result = bench.write("10 E002 0003 06 2328 1388 4A00")
    assert result.outcome == bytes.fromhex("10 E002 0003")
    assert bench.kinds() == ["Read", "Note", "Write", "Read", "Note", "Write", "Read", "Note"]
    assert [step.write.address for step in bench.steps if isinstance(step, Write)] == [0xE002, 0xE004]
    assert [part.fate for part in result.parts] == [Fate.WRITTEN, Fate.UNCHANGED, Fate.WRITTEN]
    assert [bench.holds(at) for at in (0xE002, 0xE003, 0xE004)] == [0x2328, 0x1388, 0x4A00]


def test_the_first_part_that_fails_ends_the_request_and_the_ledger_says_what_was_done(bench: Bench) -> None:
    bench.faults[3] = b"\x86\x04"  # the second write
    result = bench.write("10 E002 0003 06 2328 1388 4A00")
    assert result.outcome == b"\x90\x04", "the client asked with function 10"
    assert [part.fate for part in result.parts] == [Fate.WRITTEN, Fate.REFUSED, Fate.NOT_SENT]
    verdicts = {record.id: record for record in bench.records if isinstance(record, Verdict)}
    assert [(id_, v.fate, v.exception) for id_, v in verdicts.items()] == [
        ("job-0", Fate.WRITTEN, None),
        ("job-1", Fate.REFUSED, 4),
        ("job-2", Fate.NOT_SENT, None),
    ]
    assert bench.holds(0xE002) == 0x2328
    assert sum(isinstance(step, Write) for step in bench.steps) == 2


@pytest.mark.parametrize("error", [ReplyTimeout(), ReplyCrcError(), LineDown("unplugged")])
def test_f43_nobody_knows_what_was_not_answered_and_it_is_not_repeated(bench: Bench, error: Outcome) -> None:
    bench.faults[1] = error
    result = bench.write("06 E000 4B64")
    assert result.outcome is error
    assert bench.kinds() == ["Read", "Note", "Write", "Note"]
    assert bench.fates() == [Fate.UNKNOWN]


def test_f43_reading_back_settles_it(bench: Bench) -> None:
    old = bench.holds(VOLTAGE)
    bench.faults[1] = ReplyTimeout()
    bench.write("06 E000 4B64")
    intent = bench.records[0]
    assert isinstance(intent, Intent)
    bench.faults.clear()
    bench.faults[0] = ReplyTimeout()
    assert bench.settle(intent) == (), "it does not answer: still nobody knows"
    bench.faults.clear()
    for word, fate in ((old, Fate.NOT_WRITTEN), (0x4B64, Fate.WRITTEN), (0x4B00, Fate.DIFFERS)):
        bench.unit.handle(bytes.fromhex(f"06 E000 {word:04X}"), bench.now)
        bench.records.clear()
        assert bench.settle(intent) == (intent.id,)
        assert bench.records == [Verdict(intent.id, bench.now, fate, found=word)]


def test_what_cannot_be_read_back_is_never_settled_by_a_guess(bench: Bench) -> None:
    bench.faults[0] = ReplyTimeout()
    bench.write("05 0014 FF00")
    bench.steps.clear()
    intent = bench.records[0]
    assert isinstance(intent, Intent)
    assert bench.settle(intent, replace(intent, id="x", point="moved_since")) == (intent.id, "x")
    assert not bench.steps


def test_coils_are_settled_by_reading_them(bench: Bench) -> None:
    bench.faults[0] = ReplyTimeout()
    bench.write("05 0001 FF00")
    intent = bench.records[0]
    assert isinstance(intent, Intent)
    bench.faults.clear()
    bench.unit.handle(bytes.fromhex("05 0001 FF00"), bench.now)
    assert bench.settle(intent) == (intent.id,)
    assert bench.fates() == [Fate.UNKNOWN, Fate.WRITTEN]


def test_a_device_that_confirms_and_holds_something_else_is_04(bench: Bench) -> None:
    bench.faults[1] = bytes.fromhex("06 E000 4B64")  # confirmed, not done
    result = bench.write("06 E000 4B64")
    assert isinstance(result.outcome, WriteDiffers)
    assert result.outcome.exception_code == 0x04
    verdict = bench.records[1]
    assert isinstance(verdict, Verdict)
    assert (verdict.fate, verdict.found) == (Fate.DIFFERS, bench.holds(VOLTAGE))


def test_a_write_that_cannot_be_read_back_is_unknown(bench: Bench) -> None:
    bench.faults[2] = ReplyTimeout()
    result = bench.write("06 E000 4B64")
    assert isinstance(result.outcome, ReplyTimeout)
    assert bench.fates() == [Fate.UNKNOWN]


@pytest.mark.parametrize(
    "why",
    [QueueFull("array-1"), ShuttingDown(), LineDown("unplugged"), b"\x83\x06"],
    ids=["full", "stopping", "closed", "busy"],
)
def test_a_write_that_cannot_be_read_back_for_now_is_0b_and_not_06_or_0a(bench: Bench, why: Outcome) -> None:
    bench.faults[2] = why
    result = bench.write("06 E000 4B64")
    assert isinstance(result.outcome, Unconfirmed)
    assert result.outcome.exception_code == 0x0B
    assert bench.fates() == [Fate.UNKNOWN]


@pytest.mark.parametrize("error", [EchoUnknown(), DeviceOffline(), IllegalFunction()])
def test_what_the_line_did_not_send_costs_no_wear(bench: Bench, error: Outcome) -> None:
    for _ in range(5):
        bench.faults[1] = error
        result = bench.write("06 E000 4B64")
        assert [part.fate for part in result.parts] == [Fate.NOT_SENT]
    bench.faults.clear()
    assert bench.write("06 E000 4B64").parts[0].fate is Fate.WRITTEN


def test_without_comparison_nothing_is_written(bench: Bench) -> None:
    bench.faults[0] = ReplyTimeout()
    assert isinstance(bench.write("06 E000 4B64").outcome, ReplyTimeout)
    bench.faults[0] = b"\x83\x02"
    assert bench.write("06 E000 4B64").outcome == b"\x86\x02"
    bench.faults[0] = b"\x03\x04\x00\x00\x00\x00"
    assert bench.write("06 E000 4B64").parts[0].error == "mismatch"
    assert not bench.records


def test_f44_over_the_budget_it_is_06_and_nothing_of_the_request_is_sent(bench: Bench) -> None:
    for value in (0x4B64, 0x4B65, 0x4B66):
        bench.now += 10
        assert isinstance(bench.write(f"06 E000 {value:04X}").outcome, bytes)
    bench.now += 10
    bench.records.clear()
    result = bench.write("10 E000 0002 04 4B67 4A00")
    assert isinstance(result.outcome, WriteBudgetSpent)
    assert result.outcome.exception_code == 0x06
    assert bench.kinds() == ["Read"]
    assert [part.fate for part in result.parts] == [Fate.NOT_SENT, Fate.NOT_SENT]
    bench.now += 86_400
    assert isinstance(bench.write("06 E000 4B67").outcome, bytes)


def test_too_soon_is_06(bench: Bench) -> None:
    bench.write("05 0001 FF00")
    assert isinstance(bench.write("05 0001 0000").outcome, WriteTooSoon)
    bench.now += 1.0
    assert isinstance(bench.write("05 0001 0000").outcome, bytes)


def test_what_cannot_be_noted_is_not_written(bench: Bench) -> None:
    bench.disk_full = True
    result = bench.write("06 E000 4B64")
    assert isinstance(result.outcome, LedgerUnavailable)
    assert result.outcome.exception_code == 0x04
    assert bench.kinds() == ["Read", "Note"]
    assert not bench.unit.writes


def test_ram_and_coils_are_written_without_reading(bench: Bench) -> None:
    data = bytes.fromhex("4C00") * 0x52
    bench.device.snapshot = replace(
        bench.device.snapshot,
        blocks=(Block(Space.REGISTERS, 0, 0x52, data, 999.0), Block(Space.COILS, 0, 8, b"\x02", 999.0)),
    )
    assert isinstance(bench.write("06 004F 4D00").outcome, bytes)
    assert bench.kinds() == ["Note", "Write", "Note"]
    assert isinstance(bench.write("0F 0000 0002 01 01").outcome, bytes)
    assert bench.kinds() == ["Note", "Write", "Note", "Write", "Note"]
    olds = [record.old for record in bench.records if isinstance(record, Intent)]
    assert olds == [0x4C00, 0, 1], "from the snapshot"


def test_a_device_that_is_not_online_is_not_written(bench: Bench) -> None:
    bench.device.snapshot = replace(bench.device.snapshot, state=DeviceState.STALE)
    assert isinstance(bench.write("06 004F 4D00").outcome, DeviceOffline)
    bench.line.state = LineState.DOWN
    assert isinstance(bench.write("06 004F 4D00").outcome, LineDown)
    assert not bench.steps


def test_a_line_that_closed_in_between_has_not_sent_it(bench: Bench) -> None:
    job = bench.job("06 004F 4D00")
    steps = perform(job, bench.wear, Moment(1000.0, 1000.0))
    assert isinstance(next(steps), Note)
    bench.line.state = LineState.DOWN
    note = steps.send(Moment(1000.0, 1000.0))
    assert isinstance(note, Note)
    assert [record.fate for record in note.records if isinstance(record, Verdict)] == [Fate.NOT_SENT]


def test_slave_control_goes_out_first_and_is_noted_afterwards(bench: Bench) -> None:
    bench.disk_full = True
    bench.device.snapshot = Snapshot()  # whatever the state: the line decides
    for request in ("06 0025 4B00", "10 0025 0001 02 4B00"):
        assert bench.job(request).slave_control
        result = bench.control(request)
        assert result.outcome == bytes.fromhex(request)[:5]
        assert bench.kinds()[0] == "Write"
        assert all(not step.before for step in bench.steps if isinstance(step, Note))
    assert bench.unit.writes == [(Space.REGISTERS, 0x25, 0x4B00)] * 2


def test_the_ledger_hears_of_slave_control_when_its_value_changes_once_a_minute_at_most(bench: Bench) -> None:
    def write(value: int) -> None:
        assert isinstance(bench.control(f"06 0025 {value:04X}").outcome, bytes)
        bench.now += 10

    for value in (0x4B00, 0x4B00, 0x4B00, 0x4B10, 0x4B20, 0x4B30, 0x4B30, 0x4B30):
        write(value)
    noted = [(record.new, record.left_out) for record in bench.records if isinstance(record, Intent)]
    assert noted == [(0x4B00, 0), (0x4B30, 5)]
    assert bench.fates() == [Fate.WRITTEN, Fate.WRITTEN]


def test_slave_control_on_a_closed_line_is_told_at_once(bench: Bench) -> None:
    bench.line.state = LineState.DOWN
    result = bench.control("06 0025 4B00")
    assert isinstance(result.outcome, LineDown)
    assert result.parts[0].fate is Fate.NOT_SENT
    assert not bench.steps


def test_slave_control_without_an_answer_is_unknown(bench: Bench) -> None:
    bench.faults[0] = ReplyTimeout()
    result = bench.control("06 0025 4B00")
    assert isinstance(result.outcome, ReplyTimeout)
    assert bench.fates() == [Fate.UNKNOWN]


@pytest.mark.parametrize(
    ("pdu", "reason", "error"),
    [
        ("06 0018 0000", Reason.WRITE_NOT_ALLOWED, IllegalFunction),  # read only
        ("05 0020 FF00", Reason.WRITE_NOT_ALLOWED, IllegalFunction),  # the lighting test
        ("10 E038 0002 04 4000 4000", Reason.WRITE_NOT_ALLOWED, IllegalFunction),  # the second is reserved
        ("06 E000 7E00", Reason.WRITE_VALUE, IllegalDataValue),
        ("10 E000 0002 04 4B64 7C00", Reason.WRITE_VALUE, IllegalDataValue),
    ],
)
def test_f42_a_request_is_refused_whole(bench: Bench, pdu: str, reason: Reason, error: type[Exception]) -> None:
    refusal = plan(bytes.fromhex(pdu), WriteRules([RULE], bench.device), SCADA, "x")
    assert isinstance(refusal, Refusal)
    assert refusal.decision.reason is reason
    assert isinstance(refusal.error, error)
