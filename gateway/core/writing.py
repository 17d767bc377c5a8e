"""How a write that is allowed is done, step by step; sans-IO: each step is asked for and answered.

Rule 1: a request is planned whole: well formed, every part allowed, every value within its limits, before anything
        else happens (F42). Then, for what wears, the registers are read and compared: what holds its value already is
        not written. Then every part that is left must keep the limits of wear; if one does not, none is written.
Rule 2: the intent of every part stands in the ledger, on the disk, before the first byte goes out.
Rule 3: the parts go out one by one in order, each once (F43). The first that fails ends the request with its exception;
        the parts after it are not sent. The ledger says of each what became of it.
Rule 4: a part that wears is read back. Another value is exception 04 and "differs". Where that cannot be now, nobody
        knows (rule 5), and the exception is neither 06 nor 0A, which say that nothing was done.
Rule 5: when no answer came, nobody knows ("unknown"), until the register was read back (`settle`). A line that closed
        may have been closed under way, so it is "unknown" too.
Rule 6: what a controller needs again and again (slave control) goes out at once: not compared, not read back, not held
        back by the limits of wear or by the ledger, which hears of it afterwards.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import dataclass, field, replace

from gateway.core.log_budget import LogBudget
from gateway.core.site import Device, LineState, Outcome
from gateway.core.snapshot import DeviceState
from gateway.core.write_ledger import Fate, Intent, Record, Verdict
from gateway.core.write_request import SingleWrite, success_reply
from gateway.core.write_rules import Requester
from gateway.core.write_wear import Cell, Wear
from gateway.devices.model import Access, Point, Space
from gateway.errors import (
    Busy,
    DeviceOffline,
    IdentityUnproven,
    IllegalFunction,
    LineDown,
    PathUnavailable,
    ReplyMismatch,
    RequestError,
    Unconfirmed,
    WriteDiffers,
)
from gateway.modbus.pdu import ReadRequest, exception_reply, is_exception

_NEVER_SENT = (Busy, DeviceOffline, IdentityUnproven, IllegalFunction)
"""How the line refuses a write that it has not sent."""


@dataclass(frozen=True, slots=True)
class Part:
    """One single write of a job."""

    write: SingleWrite
    point: Point
    wears: bool

    @property
    def compared(self) -> bool:
        """Whether it is read before and after (rules 1 and 4)."""
        return self.wears and self.write.space is Space.REGISTERS


@dataclass(frozen=True, slots=True)
class Job:
    """A write request that is allowed."""

    id: str  # unique among all entries of the ledger
    requester: Requester
    device: Device
    pdu: bytes
    parts: tuple[Part, ...]

    @property
    def slave_control(self) -> bool:
        """Rule 6."""
        return all(part.point.rewrite_s is not None for part in self.parts)


@dataclass(frozen=True, slots=True)
class Moment:
    """When a step ended, by both clocks, and how."""

    now: float
    wall: float
    outcome: Outcome = b""


@dataclass(frozen=True, slots=True)
class Read:
    """Ask the line for a read."""

    pdu: bytes


@dataclass(frozen=True, slots=True)
class Write:
    """Have the line make a single write."""

    write: SingleWrite


@dataclass(frozen=True, slots=True)
class Note:
    """Put records into the ledger; when `before` is set, go on only when they are on the disk."""

    records: tuple[Record, ...]
    before: bool = False


Step = Read | Write | Note


@dataclass(frozen=True, slots=True)
class PartResult:
    """What became of a part."""

    part: Part
    old: int | None
    fate: Fate
    error: str = ""  # the error's label, or "exception_NN" of the device


@dataclass(frozen=True, slots=True)
class Result:
    """The reply to the client, and what became of every part."""

    outcome: Outcome
    parts: tuple[PartResult, ...]


Procedure = Generator[Step, Moment, Result]


def perform(job: Job, wear: Wear, begun: Moment) -> Procedure:
    """Do a job (rules 1 to 5)."""
    return (yield from _Performance(job, wear).run(begun))


class _Performance:
    """One job under way."""

    def __init__(self, job: Job, wear: Wear) -> None:
        self._job = job
        self._wear = wear
        self._old: dict[int, int] = {}
        self._results: dict[int, PartResult] = {}  # by the part's position

    def run(self, moment: Moment) -> Procedure:
        """Rules 1 to 4."""
        job = self._job
        try:
            check_reachable(job.device, moment.now)
            moment = yield from self._compare(moment)
            todo = [(at, part) for at, part in enumerate(job.parts) if at not in self._results]
            for _, part in todo:
                self._wear.check(self._cell(part), moment.now, wears=part.wears)
            if todo:
                moment = yield Note(tuple(self._intent(at, part, moment.wall) for at, part in todo), before=True)
                _raise(moment.outcome)
        except _Refusal as refusal:
            return self._ended(refusal.outcome)
        except RequestError as error:
            return self._ended(error)
        for at, part in todo:
            outcome = yield from self._one(at, part, moment)
            if isinstance(outcome, RequestError) or is_exception(outcome):
                rest = tuple(Verdict(self._id(later), moment.wall, Fate.NOT_SENT) for later, _ in todo if later > at)
                if rest:
                    yield Note(rest)
                return self._ended(outcome)
        return self._ended(success_reply(job.pdu))

    def _compare(self, moment: Moment) -> Generator[Step, Moment, Moment]:
        """Learn what is there; parts that hold their value already are done."""
        for at, part in enumerate(self._job.parts):
            known = _word(self._job.device, part.write)
            if known is not None:
                self._old[at] = known
        compared = [(at, part) for at, part in enumerate(self._job.parts) if part.compared]
        if not compared:
            return moment
        first, last = compared[0][1].write.address, compared[-1][1].write.address
        moment = yield Read(_read(self._job.device, Space.REGISTERS, first, last - first + 1))
        words = _words(moment.outcome, last - first + 1)
        for at, part in compared:
            self._old[at] = words[part.write.address - first]
            if self._old[at] == part.write.value:
                self._results[at] = PartResult(part, self._old[at], Fate.UNCHANGED)
        return moment

    def _one(self, at: int, part: Part, moment: Moment) -> Generator[Step, Moment, Outcome]:
        cell = self._cell(part)
        self._wear.spend(cell, moment.now, wears=part.wears)
        moment, fate = yield from _send(self._job.device, part, moment)
        outcome, found = moment.outcome, None
        if fate is Fate.NOT_SENT:
            self._wear.take_back(cell, wears=part.wears)
        if fate is Fate.WRITTEN and part.compared:
            moment = yield Read(_read(self._job.device, part.write.space, part.write.address, 1))
            try:
                found = _words(moment.outcome, 1)[0]
            except _Refusal as refusal:
                fate, outcome = Fate.UNKNOWN, refusal.outcome
                if _code(outcome) in {Busy.exception_code, PathUnavailable.exception_code}:
                    outcome = Unconfirmed(part.point.name)
            else:
                if found != part.write.value:
                    fate, outcome = Fate.DIFFERS, WriteDiffers(part.point.name)
        self._results[at] = PartResult(part, self._old.get(at), fate, _label(outcome))
        yield Note((Verdict(self._id(at), moment.wall, fate, _code(outcome), found),))
        return outcome

    def _ended(self, outcome: Outcome) -> Result:
        label = _label(outcome)
        parts = (
            self._results.get(at) or PartResult(part, self._old.get(at), Fate.NOT_SENT, label)
            for at, part in enumerate(self._job.parts)
        )
        return Result(_as_answer(self._job, outcome), tuple(parts))

    def _intent(self, at: int, part: Part, wall: float) -> Intent:
        return _intent(self._job, part, at, wall=wall, old=self._old.get(at))

    def _id(self, at: int) -> str:
        return _id(self._job, at)

    def _cell(self, part: Part) -> Cell:
        return (self._job.device.unit_id, part.write.space, part.write.address)


@dataclass(slots=True)
class SlaveControl:
    """The writes of rule 6, of all devices: what the ledger has heard of them."""

    _told: dict[Cell, int] = field(default_factory=dict)
    _left_out: dict[Cell, int] = field(default_factory=dict)
    _budgets: dict[Cell, LogBudget] = field(default_factory=dict)

    def perform(self, job: Job, moment: Moment) -> Procedure:
        """Send the parts at once; note a value that is new, at most once a minute a register."""
        results: list[PartResult] = []
        outcome: Outcome = success_reply(job.pdu)
        for at, part in enumerate(job.parts):
            old = _word(job.device, part.write)
            moment, fate = yield from _send(job.device, part, moment)
            results.append(PartResult(part, old, fate, _label(moment.outcome)))
            cell = (job.device.unit_id, part.write.space, part.write.address)
            left_out = None if fate is Fate.NOT_SENT else self._worth_noting(cell, part, moment)
            if left_out is not None:
                intent = _intent(job, part, at, wall=moment.wall, old=old, left_out=left_out)
                yield Note((intent, Verdict(intent.id, moment.wall, fate, _code(moment.outcome))))
            if fate is not Fate.WRITTEN:
                outcome = moment.outcome
                break
        results += [PartResult(part, None, Fate.NOT_SENT) for part in job.parts[len(results) :]]
        return Result(_as_answer(job, outcome), tuple(results))

    def _worth_noting(self, cell: Cell, part: Part, moment: Moment) -> int | None:
        """How many writes were left out before this one, or None when it is left out itself."""
        if self._told.get(cell) != part.write.value:
            budget = self._budgets.setdefault(cell, LogBudget(lines=1))
            if budget.spend(cell, moment.now) is not None:
                self._told[cell] = part.write.value
                return self._left_out.pop(cell, 0)
        self._left_out[cell] = self._left_out.get(cell, 0) + 1
        return None


def settle(intents: Sequence[Intent], device: Device) -> Generator[Step, Moment, tuple[str, ...]]:
    """Read back what nobody knows (rule 5); gives the ids that are settled now, or never can be."""
    settled: list[str] = []
    for intent in intents:
        point = device.map.writable_point(intent.space, intent.address)
        if point is None or point.name != intent.point or not can_be_read_back(point):
            settled.append(intent.id)
            continue
        moment = yield Read(_read(device, intent.space, intent.address, 1))
        try:
            found = _words(moment.outcome, 1, intent.space)[0]
        except _Refusal:
            break
        fate = Fate.WRITTEN if found == intent.new else Fate.NOT_WRITTEN if found == intent.old else Fate.DIFFERS
        settled.append(intent.id)
        yield Note((Verdict(intent.id, moment.wall, fate, found=found),))
    return tuple(settled)


def can_be_read_back(point: Point) -> bool:
    """Whether reading the point tells what was written; a command reads 0, slave control is written anew."""
    return point.access is Access.WRITE and point.rewrite_s is None


def check_reachable(device: Device, now: float) -> None:
    """Raise LineDown or DeviceOffline unless the device is online, and so has proved to be the one expected."""
    if device.snapshot.state is not DeviceState.ONLINE:
        if device.line.status(now).state is LineState.DOWN:
            raise LineDown
        raise DeviceOffline(device.name)


class _Refusal(Exception):
    """A read that brought no words; `outcome` is what came instead."""

    def __init__(self, outcome: Outcome) -> None:
        super().__init__()
        self.outcome = outcome


def _raise(outcome: Outcome) -> None:
    if isinstance(outcome, RequestError):
        raise outcome


def _words(outcome: Outcome, count: int, space: Space = Space.REGISTERS) -> list[int]:
    if isinstance(outcome, RequestError) or is_exception(outcome):
        raise _Refusal(outcome)
    data = outcome[2:]
    if space is Space.COILS:
        return [data[at // 8] >> at % 8 & 1 for at in range(count)]
    if len(data) != 2 * count:
        raise _Refusal(ReplyMismatch("a read of another length"))
    return [int.from_bytes(data[at : at + 2]) for at in range(0, 2 * count, 2)]


def _word(device: Device, write: SingleWrite) -> int | None:
    """What the snapshot holds of a register or coil."""
    for block in device.snapshot.blocks:
        if block.space is write.space and block.first <= write.address < block.first + block.count:
            at = write.address - block.first
            if write.space is Space.COILS:
                return block.data[at // 8] >> at % 8 & 1
            return int.from_bytes(block.data[2 * at : 2 * at + 2])
    return None


def _read(device: Device, space: Space, first: int, count: int) -> bytes:
    return ReadRequest(device.map.read_function(space), first, count).encode()


def _send(device: Device, part: Part, moment: Moment) -> Generator[Step, Moment, tuple[Moment, Fate]]:
    """Have the line make one single write; a line that is closed before it is asked has certainly not sent it."""
    if device.line.status(moment.now).state is LineState.DOWN:
        return replace(moment, outcome=LineDown()), Fate.NOT_SENT
    moment = yield Write(part.write)
    if isinstance(moment.outcome, _NEVER_SENT):
        return moment, Fate.NOT_SENT
    if isinstance(moment.outcome, RequestError):
        return moment, Fate.UNKNOWN
    return moment, Fate.REFUSED if is_exception(moment.outcome) else Fate.WRITTEN


def _as_answer(job: Job, outcome: Outcome) -> Outcome:
    """The outcome of a part as one of the request: an exception carries the function that the client asked for."""
    if isinstance(outcome, RequestError) or not is_exception(outcome):
        return outcome
    return exception_reply(job.pdu[0], outcome[1])


def _label(outcome: Outcome) -> str:
    if isinstance(outcome, RequestError):
        return outcome.label
    return f"exception_{outcome[1]:02X}" if is_exception(outcome) else ""


def _code(outcome: Outcome) -> int | None:
    if isinstance(outcome, RequestError):
        return outcome.exception_code
    return outcome[1] if is_exception(outcome) else None


def _id(job: Job, at: int) -> str:
    return f"{job.id}-{at}"


def _intent(job: Job, part: Part, at: int, *, wall: float, old: int | None, left_out: int = 0) -> Intent:
    return Intent(
        id=_id(job, at),
        at=round(wall, 3),
        peer=job.requester.address,
        role=job.requester.role,
        unit_id=job.device.unit_id,
        device=job.device.name,
        point=part.point.name,
        space=part.write.space,
        address=part.write.address,
        old=old,
        new=part.write.value,
        wears=part.wears,
        left_out=left_out,
    )
