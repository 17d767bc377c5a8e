"""Writes at work: drives the procedures of core/writing.py with the lines and the ledger.

Rule 1: the writes of one device go one after another, at most `QUEUE_LIMIT` of them wait; one more is 06. Slave
        control does not wait for them.
Rule 2: a write that has begun goes on when its client leaves; one that has not is dropped.
Rule 3: as long as the ledger (journal.py) cannot be opened or written, writes are refused with 04; reads know
        nothing of it.
Rule 4: what nobody knows is read back before the next write to the device, and every `SETTLE_S` while the device is
        online; so is, after a start, what the last run left open. Another device that has its unit id by then is not
        asked.
"""

from __future__ import annotations

import asyncio
import logging
import secrets
from collections import deque
from collections.abc import Callable, Generator, Iterable, Mapping
from dataclasses import dataclass

from gateway.clock import Clock
from gateway.core.policy import Audit, Refusal, plan
from gateway.core.site import Device, Outcome, Site
from gateway.core.snapshot import DeviceState
from gateway.core.stats import ModbusServerStats
from gateway.core.write_ledger import MAX_OPEN, Book, Fate, Intent, Record, Verdict
from gateway.core.write_rules import Requester, WriteRules
from gateway.core.write_wear import Wear
from gateway.core.writing import (
    Job,
    Moment,
    Note,
    Read,
    Result,
    SlaveControl,
    Step,
    can_be_read_back,
    perform,
    settle,
)
from gateway.devices.model import Space
from gateway.errors import (
    IllegalFunction,
    LedgerUnavailable,
    QueueFull,
    RequestError,
    ShuttingDown,
    Unconfirmed,
    WriteBudgetSpent,
    WriteTooSoon,
)
from gateway.faces.modbus.journal import Journal
from gateway.faces.modbus.settings import WriteSettings

logger = logging.getLogger(__name__)

QUEUE_LIMIT = 16
SETTLE_S = 5.0
_REFUSALS = (LedgerUnavailable, WriteBudgetSpent, WriteTooSoon)

Forget = Callable[[Space, int], None]


class _Order:
    """A job and who waits for it; also the `Ticket`."""

    def __init__(self, job: Job, done: Callable[[Outcome], None], forget: Forget) -> None:
        self.job = job
        self.done: Callable[[Outcome], None] | None = done
        self.forget = forget
        self.begun = False

    def cancel(self, keep: Callable[[Outcome], None] | None = None) -> None:
        """See `core.site.Ticket`; a write leaves nothing to keep."""
        del keep
        self.done = None


@dataclass(slots=True, eq=False)
class _Run:
    """A procedure under way; `over` is called with what it returned."""

    device: Device
    steps: Generator[Step, Moment, object]
    client: str
    forget: Forget
    over: Callable[[object], None]


class Writer:
    """All writes that come in by Modbus TCP."""

    def __init__(
        self, settings: WriteSettings, site: Site, clock: Clock, stats: ModbusServerStats, audit: Audit
    ) -> None:
        self._clock = clock
        self._stats = stats
        self._audit = audit
        self._devices: Mapping[int, Device] = site.by_unit
        self._rules = {device.unit_id: WriteRules(settings.rules, device) for device in site.devices}
        self._wear = Wear(settings.limits)
        self._slave = SlaveControl()
        self._journal = Journal(settings.ledger)
        self._open = False  # what the last run left is known
        self._opening = False
        self._waiting: dict[int, deque[_Order]] = {unit: deque() for unit in self._devices}
        self._running: set[int] = set()
        self._intents: dict[str, Intent] = {}  # under way
        self._unsettled: dict[str, Intent] = {}
        self._settle_timer: asyncio.TimerHandle | None = None
        self._loop: asyncio.AbstractEventLoop | None = None

    def rules(self, device: Device) -> WriteRules:
        """Who may write what on a device."""
        return self._rules[device.unit_id]

    def adjust(self, settings: WriteSettings, site: Site) -> None:
        """Other rules, limits and devices from now on; the ledger stays, and so does what was begun."""
        self._rules = {device.unit_id: WriteRules(settings.rules, device) for device in site.devices}
        busy = self._running | {unit for unit, waiting in self._waiting.items() if waiting}
        kept = {unit: device for unit, device in self._devices.items() if unit in busy}
        self._devices = {**kept, **site.by_unit}
        self._wear.limit(settings.limits)
        self._waiting = {unit: self._waiting.get(unit, deque()) for unit in self._devices}

    def refuse_waiting(self) -> None:
        """Answer those that wait: nobody may write any more."""
        for waiting in self._waiting.values():
            while waiting:
                self._tell(waiting.popleft(), Result(IllegalFunction("writes were turned off"), ()))

    def start(self) -> None:
        """Learn what the last run left; the loop runs."""
        self._loop = asyncio.get_running_loop()
        self._open_ledger()

    def stop(self) -> None:
        """Begin nothing more; what is under way ends by itself."""
        for waiting in self._waiting.values():
            waiting.clear()
        if self._settle_timer is not None:
            self._settle_timer.cancel()
            self._settle_timer = None

    def plan(self, device: Device, requester: Requester, pdu: bytes) -> Job | Refusal:
        """See `policy.plan`; raises QueueFull too (rule 1)."""
        planned = plan(pdu, self._rules[device.unit_id], requester, secrets.token_hex(6))
        full = len(self._waiting[device.unit_id]) >= QUEUE_LIMIT
        if full and isinstance(planned, Job) and not planned.slave_control:
            raise QueueFull(device.name)
        return planned

    def submit(self, job: Job, done: Callable[[Outcome], None], forget: Forget) -> _Order:
        """Do a job; `done` is called once, never before this returns, unless the ticket is cancelled.

        `forget` is told of every register or coil that was, or may have been, written.
        """
        assert self._loop is not None, "started first"
        order = _Order(job, done, forget)
        if job.slave_control:
            order.begun = True
            run = self._run_of(order, self._slave.perform(job, self._moment()), self._done_with_control)
            self._step(run, None, late=True)
        else:
            self._waiting[job.device.unit_id].append(order)
            self._loop.call_soon(self._next, job.device.unit_id)
        return order

    @staticmethod
    def given_up(ticket: object) -> RequestError:
        """What an asker is told for whom nobody can wait any longer."""
        begun = isinstance(ticket, _Order) and ticket.begun
        return Unconfirmed("given up") if begun else ShuttingDown()

    # One device's writes, one after another

    def _next(self, unit: int, *, settled: bool = False) -> None:
        if unit in self._running or unit not in self._devices:
            return
        waiting = self._waiting[unit]
        while waiting and waiting[0].done is None:
            waiting.popleft()
        if waiting and not self._open:
            self._open_ledger()
            return
        device = self._devices[unit]
        intents = [each for each in self._unsettled.values() if each.unit_id == unit and self._device_of(each)]
        if intents and not settled and device.snapshot.state is DeviceState.ONLINE:
            self._running.add(unit)
            steps = settle(intents, device)
            self._step(_Run(device, steps, "", _forget_nothing, lambda ids: self._settled(unit, ids)), None)
        elif waiting:
            self._running.add(unit)
            order = waiting.popleft()
            order.begun = True
            run = self._run_of(order, perform(order.job, self._wear, self._moment()), self._done_with_job)
            self._step(run, None)

    def _run_of(
        self, order: _Order, steps: Generator[Step, Moment, Result], over: Callable[[_Order, object], None]
    ) -> _Run:
        job = order.job
        return _Run(job.device, steps, job.requester.address, order.forget, lambda result: over(order, result))

    def _step(self, run: _Run, moment: Moment | None, *, late: bool = False) -> None:
        """Go on with a procedure as far as it does not have to wait; `late`: its end is told in a later turn."""
        try:
            step = next(run.steps) if moment is None else run.steps.send(moment)
            while isinstance(step, Note) and not step.before:
                self._remember(step.records)
                self._journal.note(*step.records)
                step = run.steps.send(self._moment())
        except StopIteration as stop:
            self._end(run, stop.value, late=late)
        except Exception:  # an edge like a connection's: a mistake here must not stop the device's other writes
            logger.exception("event=write_failed device=%s", run.device.name)
            self._end(run, None, late=late)
        else:
            self._ask(run, step)

    def _end(self, run: _Run, value: object, *, late: bool) -> None:
        if late and self._loop is not None:
            self._loop.call_soon(run.over, value)
        else:
            run.over(value)

    def _ask(self, run: _Run, step: Step) -> None:
        line = run.device.line
        if isinstance(step, Read):
            line.read(run.device, step.pdu, lambda outcome: self._step(run, self._moment(outcome)), client=run.client)
        elif isinstance(step, Note):
            records = step.records

            def noted(works: bool) -> None:  # noqa: FBT001 - the one thing there is to tell
                if works:
                    self._remember(records)
                self._step(run, self._moment(b"" if works else LedgerUnavailable()))

            self._journal.note_first(records, noted)
        else:
            write = step.write

            def written(outcome: Outcome) -> None:
                run.forget(write.space, write.address)
                self._step(run, self._moment(outcome))

            line.write(run.device, write.encode(), written, client=run.client)

    def _done_with_job(self, order: _Order, result: object) -> None:
        self._running.discard(order.job.device.unit_id)
        self._tell(order, result)
        self._next(order.job.device.unit_id)

    def _done_with_control(self, order: _Order, result: object) -> None:
        self._tell(order, result)

    def _tell(self, order: _Order, result: object) -> None:
        outcome: Outcome = RequestError("a mistake of the gateway")
        if isinstance(result, Result):
            outcome = result.outcome
            for part in result.parts:
                self._stats.writes[part.fate] += 1
                line = self._audit.written(order.job, part, self._clock.monotonic())
                if line is not None:
                    logger.info("%s", line)
            if isinstance(outcome, _REFUSALS):
                self._stats.refused[outcome.label] += 1
        done, order.done = order.done, None
        if done is not None:
            done(outcome)

    # What nobody knows

    def _settled(self, unit: int, ids: object) -> None:
        self._running.discard(unit)
        for id_ in ids if isinstance(ids, tuple) else ():
            self._unsettled.pop(id_, None)
        self._settle_later()
        self._next(unit, settled=True)

    def _settle_later(self) -> None:
        if self._unsettled and self._settle_timer is None and self._loop is not None:
            self._settle_timer = self._loop.call_later(SETTLE_S, self._settle_now)

    def _settle_now(self) -> None:
        self._settle_timer = None
        for unit in {intent.unit_id for intent in self._unsettled.values()}:
            self._next(unit)
        self._settle_later()

    # The ledger

    def _open_ledger(self) -> None:
        if not self._open and not self._opening:
            self._opening = True
            self._journal.open(self._opened)

    def _opened(self, book: Book | None) -> None:
        self._opening = False
        if book is not None and not self._open:
            self._open = True
            now, wall = self._clock.monotonic(), self._clock.wall()
            for cell, times in book.worn.items():
                for at in times:
                    self._wear.restore(cell, wall - at, now)
            self._unsettled = {id_: intent for id_, intent in book.open.items() if self._device_of(intent)}
            if book.skipped:
                logger.warning("event=write_ledger_damaged lines=%d", book.skipped)
            self._settle_later()
        for unit, waiting in self._waiting.items():
            while waiting and not self._open:
                self._tell(waiting.popleft(), Result(LedgerUnavailable(), ()))
            self._next(unit)

    def _remember(self, records: Iterable[Record]) -> None:
        """Keep what is not settled."""
        for record in records:
            if isinstance(record, Intent):
                self._intents[record.id] = record
            elif isinstance(record, Verdict):
                intent = self._intents.pop(record.id, None)
                if record.fate is not Fate.UNKNOWN:
                    unsettled = self._unsettled.pop(record.id, None)
                    if unsettled is not None:
                        unit, point, fate = unsettled.unit_id, unsettled.point, record.fate
                        logger.info("event=write_settled unit=%d point=%s outcome=%s", unit, point, fate)
                elif intent is not None:
                    self._leave_open(intent)

    def _leave_open(self, intent: Intent) -> None:
        device = self._device_of(intent)
        point = None if device is None else device.map.writable_point(intent.space, intent.address)
        if point is not None and can_be_read_back(point):
            self._unsettled[intent.id] = intent
            while len(self._unsettled) > MAX_OPEN:
                del self._unsettled[next(iter(self._unsettled))]
            self._settle_later()

    def _device_of(self, intent: Intent) -> Device | None:
        """The device that a write went to; None where its unit id stands for another one by now, or for none."""
        device = self._devices.get(intent.unit_id)
        return device if device is not None and device.name == intent.device else None

    def _moment(self, outcome: Outcome = b"") -> Moment:
        return Moment(self._clock.monotonic(), self._clock.wall(), outcome)


def _forget_nothing(space: Space, address: int) -> None:
    """Stand for a cache where nothing is written."""
    del space, address
