"""The line engine: one owner of a line, sans-IO, with time as an argument.

Rule 1: one transaction at a time; the next request goes out only when the RTU client says so (gap kept,
        quarantine over) and the scheduler says whose turn it is.
Rule 2: a client's read is tried `retries` times more, a poll waits for its next turn instead, a write is never
        repeated: when its answer is missing, nobody knows, and the old value is forgotten.
Rule 3: an exception to reads that were joined is nobody's answer: they are made again, apart.
Rule 4: a write goes out only where the settings allow writes and once it is known whether the line echoes, for an
        echo is byte for byte the answer to a write that succeeded.
Rule 5: a device that was told to restart does not answer: that silence is success, and the silence of the
        seconds after it is no failure.
Rule 6: nothing is asked for a client of a unit that has not proved to be the expected one (polling.py).
Rule 7: after a missed reply its device answers a small question of another kind before it is asked on (doubt.py).
        The turn that has to wait for it is held; when there is no answer, it is the turn that has failed.
Rule 8: a client's read that the device is too busy for (exception 06) is made once more, if there are retries at
        all; every other exception, and a second 06, is the answer.
Rule 9: a line that stops (`finish`) lets the transaction on the wire run to its end, begins nothing more, and ends
        all else that waits or comes with 06.

The shell calls `opened`, `closed`, `receive`, `on_timer`, `read` and `write`, then `step` until it returns None,
writing what it returns, and comes back at `next_deadline`. Outcomes are handed out by `step` only.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from random import Random

from gateway.core.accounting import Accounting
from gateway.core.budget import read_s
from gateway.core.coalescing import part
from gateway.core.device_record import DeviceRecord
from gateway.core.health import Breaker
from gateway.core.polling import Polling
from gateway.core.requests import ClientRead, Lane, PollItem, Purpose, ReadTurn, Span, Turn, Waiter, WriteTurn
from gateway.core.scheduler import PollList, Scheduler
from gateway.core.settings import LineSettings
from gateway.core.site import Device, LineState, LineStatus, Outcome
from gateway.core.snapshot import IDENTITY_MISMATCH, DeviceState
from gateway.core.stats import LineStats
from gateway.devices.model import Point
from gateway.errors import (
    DeviceOffline,
    DeviceSilent,
    EchoUnknown,
    IdentityUnproven,
    IllegalFunction,
    LineDown,
    QueueFull,
    QueueTimeout,
    ReplyTimeout,
    RequestError,
    ShuttingDown,
)
from gateway.modbus.collector import Echo
from gateway.modbus.pdu import Function, is_exception, parse_read
from gateway.modbus.rtu import Failed, Replied, RtuClient, State

log = logging.getLogger(__name__)

RESTART_S = 15.0
"""How long a device that was told to restart may be silent."""

_READS = frozenset(
    {
        Function.READ_COILS,
        Function.READ_DISCRETE_INPUTS,
        Function.READ_HOLDING_REGISTERS,
        Function.READ_INPUT_REGISTERS,
    }
)
_WRITES = frozenset({Function.WRITE_SINGLE_COIL, Function.WRITE_SINGLE_REGISTER})
_REFUSALS = (0x02, 0x03)
_BUSY = 0x06


class LineEngine:
    """Polls, client reads and writes of one line."""

    def __init__(self, settings: LineSettings, devices: Sequence[Device], now: float, rng: Random) -> None:
        self.settings = settings
        self.stats = LineStats()
        timing = settings.timing()
        self._rtu = RtuClient(timing, self.stats.wire, quarantine_s=settings.quarantine_s)
        self._polling = Polling(settings)
        self._records = {
            device.unit_id: DeviceRecord(device, PollList(device, Breaker(rng), self._polling.first(device, now)), now)
            for device in devices
        }
        self._scheduler = Scheduler(
            [record.polls for record in self._records.values()],
            limit=settings.queue_limit,
            limit_s=settings.queue_limit_s,
            cost=lambda space, count: read_s(timing, space, count),
            now=now,
        )
        self._accounting = Accounting(self.stats, now)
        self._turn: Turn | None = None
        self._held: Turn | None = None  # waits for the settling question that is on the wire, or was just answered
        self._window_s = self._calm_window_s = self._rtu.quarantine_s(now)
        self._sent_at = now
        self._finished: deque[tuple[Waiter, Outcome]] = deque()
        self._state = LineState.DOWN
        self._state_since = now
        self._error = "not opened yet"
        self._finishing = False

    @property
    def echo(self) -> Echo:
        """Whether the line gives our own requests back."""
        return self._rtu.echo

    def status(self, now: float) -> LineStatus:
        """The line at `now`."""
        refresh = [
            r.device.stats.refresh_s for r in self._records.values() if r.state is DeviceState.ONLINE and not r.night
        ]
        known = [refresh_s for refresh_s in refresh if refresh_s is not None]
        stretch = max(1.0, sum(known) / len(known) / self.settings.poll.live_s) if known else 1.0
        use = self._accounting.use_ratio(now)
        echo = self._rtu.echo.value
        return LineStatus(self._state, self._state_since, self._error, len(self._scheduler), use, stretch, echo)

    def opened(self, now: float) -> None:
        """The port is open: everything is read anew, quarantined devices are probed at once."""
        self._set_state(LineState.OPEN, "", now)
        self.stats.opens += 1
        self._rtu.reset(now)
        for record in self._records.values():
            record.breaker.line_opened(now)
            self._polling.restart(record, now)

    def closed(self, error: str, now: float) -> None:
        """The port is closed: what waited ends with LineDown, online devices become stale."""
        self._set_state(LineState.DOWN, error, now)
        self._rtu.reset(now)
        if self._turn is not None:
            turn, self._turn = self._turn, None
            self._records[turn.device.unit_id].doubt.missed(turn.pdu[0])
            self._accounting.ended(turn, self._sent_at, now, "line_down")
            self._finish(_waiters(turn), LineDown(error))
        if self._held is not None:
            self._finish(_waiters(self._held), LineDown(error))
            self._held = None
        self._finish(self._scheduler.drain(), LineDown(error))
        for record in self._records.values():
            if record.state is DeviceState.ONLINE:
                self._change(record, DeviceState.STALE, now, reason="line down")

    def read(
        self, device: Device, pdu: bytes, done: Callable[[Outcome], None], now: float, *, client: str, lane: Lane
    ) -> Waiter:
        """Queue a read; `done` is called by a later `step`, exactly once."""
        waiter = Waiter(done, client, now)
        try:
            self._check(device)
            span = _span(device, pdu)
            loser = self._scheduler.add_read(device, pdu, span, waiter, lane)
        except RequestError as error:
            self._finish([waiter], error)
        else:
            if loser is not None:
                self._finish(loser.waiters, QueueFull("another client asked for less"))
        return waiter

    def write(self, device: Device, pdu: bytes, done: Callable[[Outcome], None], now: float, *, client: str) -> Waiter:
        """Queue a single write (rules 2, 4 and 5); `done` is called by a later `step`, exactly once."""
        waiter = Waiter(done, client, now)
        try:
            if not self.settings.writes or len(pdu) != 5 or pdu[0] not in _WRITES:
                raise IllegalFunction("this line sends no such write")
            self._check(device)
            if self._rtu.echo is Echo.UNKNOWN:
                raise EchoUnknown("nothing was read on this line yet")
            point = _written_point(device, pdu)
            lane = Lane.SLAVE_CONTROL if point is not None and point.rewrite_s is not None else Lane.WRITE
            self._scheduler.add_write(WriteTurn(device, pdu, lane, now, waiter))
        except RequestError as error:
            self._finish([waiter], error)
        return waiter

    @property
    def busy(self) -> bool:
        """Whether a transaction is on the wire."""
        return self._turn is not None

    def adjust(self, settings: LineSettings, now: float) -> None:
        """Go on by other settings of the same wire (`LineSettings.same_wire`)."""
        self.settings = settings
        self._polling.adjust(settings, self._records.values(), now)
        self._scheduler.adjust(limit=settings.queue_limit, limit_s=settings.queue_limit_s)

    def finish(self) -> None:
        """Begin nothing more (rule 9)."""
        self._finishing = True

    def receive(self, data: bytes, now: float) -> None:
        """Bytes came from the line."""
        if self._state is LineState.DOWN:
            return
        event = self._rtu.receive(data, now)
        if event is not None:
            self._on_event(event, now)
        self._watch_window(now)

    def on_timer(self, now: float) -> None:
        """A deadline may have passed."""
        event = self._rtu.on_timer(now)
        if event is not None:
            self._on_event(event, now)
        self._watch_window(now)
        self._finish(self._scheduler.expired(now), QueueTimeout(f"waited {self.settings.queue_limit_s:g} s"))
        for record in self._records.values():
            if record.rewrites:
                self._polling.watch_rewrites(record, now)

    def step(self, now: float) -> bytes | None:
        """Hand out outcomes, then give the frame to write now, or None."""
        if self._finishing:
            held, self._held = self._held, None
            waiting = self._scheduler.drain()
            self._finish(waiting if held is None else waiting + _waiters(held), ShuttingDown())
        while self._finished:
            waiter, outcome = self._finished.popleft()
            try:
                waiter.finish(outcome)
            except Exception:  # the edge to a face: its mistake must not stop the line
                log.exception("event=outcome_handler_failed line=%s", self.settings.name)
        if self._state is LineState.DOWN or self._turn is not None or self._rtu.ready_at(now) > now:
            return None
        turn = self._next(now)
        if turn is None:
            return None
        timeout_s = turn.device.reply_timeout_s or self.settings.reply_timeout_s
        try:
            frame = self._rtu.send(turn.device.address, turn.pdu, now, timeout_s)
        except RequestError as error:  # a client's PDU that has no meaning on a serial line
            if isinstance(turn, PollItem):
                raise
            self._finish(_waiters(turn), error)
            return self.step(now)
        self._sent(turn, now)
        return frame

    def bytes_due(self) -> int:
        """How many bytes of the awaited reply are at least still to come."""
        return self._rtu.bytes_due()

    def next_deadline(self, now: float) -> float | None:
        """When the shell must call `on_timer` and `step` again; None: only after an input."""
        if self._finished:
            return now
        if self._state is LineState.DOWN:
            return None
        if self._finishing:  # polls are due, and nobody will make them
            return self._rtu.next_deadline()
        moments = [self._rtu.next_deadline(), self._scheduler.next_expiry()]
        moments += [self._polling.next_warning(record) for record in self._records.values() if record.rewrites]
        if self._turn is None and self._rtu.state is State.IDLE:
            due = now if self._held is not None else self._scheduler.next_due(now)
            moments.append(None if due is None else max(due, self._rtu.ready_at(now)))
        return min((moment for moment in moments if moment is not None), default=None)

    def _check(self, device: Device) -> None:
        """Raise why nothing can be asked of this device now."""
        record = self._records[device.unit_id]
        if self._finishing:
            raise ShuttingDown
        if self._state is LineState.DOWN:
            raise LineDown(self._error)
        if record.breaker.is_open:
            raise DeviceOffline(device.name)
        if not record.verified and (
            record.known.at or record.known.product or IDENTITY_MISMATCH in device.snapshot.warnings
        ):
            raise IdentityUnproven(device.name)

    def _next(self, now: float) -> Turn | None:
        """The turn to make now, or the settling question that must be answered before it (rule 7)."""
        if self._finishing:
            return None
        turn, self._held = self._held, None
        if turn is None or not _wanted(turn):
            turn = self._scheduler.next(now)
        if turn is None:
            return None
        record = self._records[turn.device.unit_id]
        if record.doubt.allows(turn.pdu[0]):
            return turn
        self._held = turn
        return self._polling.settling(record, now)

    def _sent(self, turn: Turn, now: float) -> None:
        self._turn = turn
        self._sent_at = now
        self._begun(turn, now)
        self._accounting.sent(turn, now)

    def _begun(self, turn: Turn, now: float) -> None:
        if isinstance(turn, PollItem):
            self._polling.started(turn, self._records[turn.device.unit_id], now)
        elif isinstance(turn, ReadTurn):
            for read in turn.reads:
                read.attempts += 1

    def _on_event(self, event: Replied | Failed, now: float) -> None:
        turn, self._turn = self._turn, None
        assert turn is not None, "the RTU client reports only what was sent"
        record = self._records[turn.device.unit_id]
        if isinstance(event, Failed):
            self._accounting.ended(turn, self._sent_at, now, event.error.label)
            record.doubt.missed(turn.pdu[0])
            if turn.purpose is Purpose.SETTLE:
                self._on_unsettled(record, event.error, now)
            else:
                self._on_failure(turn, record, event.error, now)
        else:
            exception = is_exception(event.pdu)
            turn.device.stats.exceptions += exception
            self._accounting.ended(turn, self._sent_at, now, "exception" if exception else None)
            record.doubt.answered(turn.pdu[0])
            self._heard(record, now)
            if turn.purpose is Purpose.SETTLE:
                record.heard(now)
                if isinstance(self._held, PollItem):
                    self._held = None  # it is due still, if it is still wanted
            else:
                self._on_reply(turn, record, event, now)
        if isinstance(turn, ReadTurn):
            self._scheduler.charge(turn, now - self._sent_at)
        self._judge(record, now)

    def _on_reply(self, turn: Turn, record: DeviceRecord, event: Replied, now: float) -> None:
        if isinstance(turn, PollItem):
            if is_exception(event.pdu):
                self._polling.refused(turn, record, event.pdu[1], now)
            else:
                self._polling.replied(turn, record, event, now)
            return
        record.heard(now)
        if isinstance(turn, WriteTurn):
            if not is_exception(event.pdu):
                self._written(turn, record, now)
            self._finish([turn.waiter], event.pdu)
        elif is_exception(event.pdu) and len(turn.reads) > 1:
            if turn.span is not None and event.pdu[1] in _REFUSALS:
                record.polls.refused(turn.span.space, turn.span.count)
            for read in reversed(turn.reads):
                read.alone = True
                self._scheduler.retry(read)
        elif self._puts_off(turn, event.pdu):
            turn.reads[0].put_off = True
            self._scheduler.retry(turn.reads[0])
        else:
            for read in turn.reads:
                self._finish(read.waiters, _answer(turn, read, event.pdu))

    def _on_failure(self, turn: Turn, record: DeviceRecord, error: RequestError, now: float) -> None:
        silent = isinstance(error, ReplyTimeout)
        if isinstance(turn, WriteTurn):
            point = _written_point(turn.device, turn.pdu)
            if silent and point is not None and point.restarts:
                self._written(turn, record, now)
                record.restarting_until = now + RESTART_S
                self._finish([turn.waiter], turn.pdu)  # the answer to a write is its echo
                return
        self._missed(record, error, now, optional=isinstance(turn, PollItem) and turn.optional)
        if isinstance(turn, PollItem):
            self._polling.failed(turn, record, now)
        elif isinstance(turn, WriteTurn):
            self._written(turn, record, now)  # perhaps: what was there is not known any more
            self._finish([turn.waiter], error)
        else:
            for read in reversed(turn.reads):
                if record.breaker.is_open or read.attempts > self.settings.retries or not read.wanted:
                    self._finish(read.waiters, error)
                else:
                    self._scheduler.retry(read)

    def _on_unsettled(self, record: DeviceRecord, error: RequestError, now: float) -> None:
        """The settling question failed, and with it the turn that was held for it (rule 7)."""
        turn, self._held = self._held, None
        if turn is None:  # ended by rule 9
            return
        if isinstance(turn, WriteTurn):
            self._missed(record, error, now)
            silent = isinstance(error, ReplyTimeout)
            self._finish([turn.waiter], DeviceSilent("it is silent; the write was not made") if silent else error)
        else:
            self._begun(turn, now)
            self._on_failure(turn, record, error, now)

    def _missed(self, record: DeviceRecord, error: RequestError, now: float, *, optional: bool = False) -> None:
        """A device gave no good reply: what that says about it."""
        record.device.stats.failures += 1
        if not isinstance(error, ReplyTimeout):
            self._heard(record, now)  # it speaks, if not clearly
        elif now >= record.restarting_until and not optional:
            record.breaker.missed(now)

    def _puts_off(self, turn: ReadTurn, pdu: bytes) -> bool:
        return is_exception(pdu) and pdu[1] == _BUSY and self.settings.retries > 0 and not turn.reads[0].put_off

    def _watch_window(self, now: float) -> None:
        """Say when late replies made the quarantine longer, and when it is as configured again."""
        window_s = self._rtu.quarantine_s(now)
        if window_s > self._window_s:
            log.warning("event=late_replies line=%s quarantine_s=%g", self.settings.name, window_s)
        elif window_s < self._window_s and window_s <= self._calm_window_s:
            log.info("event=late_replies_over line=%s quarantine_s=%g", self.settings.name, window_s)
        self._window_s = window_s

    def _written(self, turn: WriteTurn, record: DeviceRecord, now: float) -> None:
        """A write was, or may have been, taken: forget the old value and watch what must be rewritten."""
        space = turn.device.map.write_functions[turn.pdu[0]]
        address = int.from_bytes(turn.pdu[1:3], "big")
        self._polling.wanted_again(record, space, address, now)
        point = _written_point(turn.device, turn.pdu)
        if point is None or point.rewrite_s is None:
            return
        held = point.released.held_by(int.from_bytes(turn.pdu[3:5], "big"), held=point.name in record.rewrites)
        if held:
            record.rewrites[point.name] = now
        else:
            record.rewrites.pop(point.name, None)
        self._polling.watch_rewrites(record, now)

    def _heard(self, record: DeviceRecord, now: float) -> None:
        """The device is there; after a quarantine everything is read anew."""
        record.restarting_until = 0.0
        if record.breaker.is_open:
            self._polling.restart(record, now)
        record.breaker.replied()

    def _judge(self, record: DeviceRecord, now: float) -> None:
        state = self._polling.judge(record)
        if state is record.state:
            return
        self._change(record, state, now, reason="silent" if state is DeviceState.OFFLINE else "")
        if state is DeviceState.OFFLINE:
            record.device.stats.went_offline += 1
            self._finish(self._scheduler.drain(record.device), DeviceOffline(record.device.name))

    def _change(self, record: DeviceRecord, state: DeviceState, now: float, reason: str) -> None:
        before = record.state
        lasted_s = record.become(state, now)
        log.log(
            logging.INFO if state is DeviceState.ONLINE else logging.WARNING,
            "event=device_%s line=%s device=%s address=%d before=%s lasted_s=%.1f%s",
            state,
            self.settings.name,
            record.device.name,
            record.device.address,
            before,
            lasted_s,
            f' reason="{reason}"' if reason else "",
        )

    def _finish(self, waiters: Iterable[Waiter], outcome: Outcome) -> None:
        self._finished.extend((waiter, outcome) for waiter in waiters)

    def _set_state(self, state: LineState, error: str, now: float) -> None:
        if state is not self._state:
            self._state_since = now
        self._state = state
        self._error = error


def _wanted(turn: Turn) -> bool:
    """Whether anybody still waits for it."""
    if isinstance(turn, ReadTurn):
        return any(read.wanted for read in turn.reads)
    return not (isinstance(turn, WriteTurn) and turn.waiter.left)


def _waiters(turn: Turn) -> list[Waiter]:
    if isinstance(turn, ReadTurn):
        return [waiter for read in turn.reads for waiter in read.waiters]
    return [turn.waiter] if isinstance(turn, WriteTurn) else []


def _answer(turn: ReadTurn, read: ClientRead, reply: bytes) -> bytes:
    """The read's own part of a turn's reply."""
    if len(turn.reads) == 1 or turn.span is None or read.span is None:
        return reply
    return part(reply, turn.span, read.span)


def _span(device: Device, pdu: bytes) -> Span | None:
    """What a read asks for; None for identification. Raises the RequestError that refuses anything else."""
    if pdu and pdu[0] in _READS and pdu[0] in device.map.functions:
        return Span.of(device, parse_read(pdu))
    if pdu and pdu[0] == Function.READ_IDENTIFICATION:
        return None
    raise IllegalFunction("only reads are sent")


def _written_point(device: Device, pdu: bytes) -> Point | None:
    space = device.map.write_functions.get(pdu[0])
    return None if space is None else device.map.writable_point(space, int.from_bytes(pdu[1:3], "big"))
