"""The line engine: one owner of a line, sans-IO, with time as an argument.

Rule 1: the next request goes out only when the wire says so (a serial line: one transaction at a time, gap kept,
        quarantine over; an upstream: room for one more) and the scheduler says whose turn it is.
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
Rule 9: a line that stops (`finish`) lets what is under way run to its end, begins nothing more, and ends all else
        that waits or comes with 06. A write that was sent never ends so, nor with 0A when its line is closed: that
        would say that nothing was done.
Rule 10: a request that ended through no fault of its own (an upstream's connection was lost, or others were under way
        with it) is made once more, with the line to itself. Nobody counts it against the device. A write is not.
Rule 11: what a gateway says in the place of a device (exceptions 0A and 0B of an upstream) is the answer to clients,
        and a missed reply of that device.

The shell calls `opened`, `closed`, `receive`, `on_timer`, `read` and `write`, then `step` until it returns None,
writing what it returns, and comes back at `next_deadline`. Outcomes are handed out by `step` only.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from random import Random

from gateway.core.accounting import Accounting
from gateway.core.budget import read_cost
from gateway.core.device_record import DeviceRecord
from gateway.core.health import FIRST_PROBE_S, LAST_PROBE_S, Breaker
from gateway.core.line_news import STOPPING, LineNews
from gateway.core.outcomes import Outcomes
from gateway.core.polling import Polling
from gateway.core.requests import Lane, PollItem, Purpose, ReadTurn, Turn, Waiter, WriteTurn
from gateway.core.rewrites import Rewrites
from gateway.core.scheduler import PollList, Scheduler
from gateway.core.set_aside import SetAside
from gateway.core.settings import LineSettings
from gateway.core.site import Device, LineState, LineStatus, Outcome
from gateway.core.snapshot import IDENTITY_MISMATCH, DeviceState
from gateway.core.stats import LineStats
from gateway.core.turns import part_of, span_of, waiters_of, written_point
from gateway.core.under_way import UnderWay
from gateway.errors import (
    DeviceOffline,
    DeviceSilent,
    EchoUnknown,
    IdentityUnproven,
    IllegalFunction,
    LineDown,
    QueueFull,
    QueueTimeout,
    RelayedNoPath,
    RelayedSilence,
    ReplyTimeout,
    RequestError,
    ShuttingDown,
    Unconfirmed,
)
from gateway.modbus.collector import Echo
from gateway.modbus.pdu import EXCEPTION_BIT, Function, is_exception
from gateway.modbus.rtu_wire import RtuWire
from gateway.modbus.transactions import Ended, Failed, Replied, Wire

RESTART_S = 15.0
"""How long a device that was told to restart may be silent."""

_WRITES = frozenset({Function.WRITE_SINGLE_COIL, Function.WRITE_SINGLE_REGISTER})
_REFUSALS = (0x02, 0x03)
_BUSY = 0x06
_RELAYED = {0x0A: RelayedNoPath, 0x0B: RelayedSilence}


class LineEngine:
    """Polls, client reads and writes of one line."""

    def __init__(
        self,
        settings: LineSettings,
        devices: Sequence[Device],
        now: float,
        rng: Random,
        *,
        wire: Wire | None = None,
        stats: LineStats | None = None,
    ) -> None:
        self.settings = settings
        self.stats = stats if stats is not None else LineStats()
        self._wire: Wire = (
            wire
            if wire is not None
            else RtuWire(settings.timing(), self.stats.wire, quarantine_s=settings.quarantine_s)
        )
        self._under_way = UnderWay()
        self._polling = Polling(settings)
        self._records = {
            device.unit_id: DeviceRecord(device, PollList(device, Breaker(rng), self._polling.first(device, now)), now)
            for device in devices
        }
        self._scheduler = Scheduler(
            [record.polls for record in self._records.values()],
            limit=settings.queue_limit,
            limit_s=settings.queue_limit_s,
            cost=read_cost(settings),
            now=now,
            under_way=self._under_way,
        )
        self._accounting = Accounting(self.stats, now)
        self._aside = SetAside(self._under_way)
        self._news = LineNews(settings.name, self._wire.quarantine_s(now))
        self._outcomes = Outcomes(settings.name)
        self._finish = self._outcomes.add
        self._state = LineState.DOWN
        self._state_since = now
        self._error = "not opened yet"
        self._finishing = False
        self._rewrites = Rewrites(self._polling)

    @property
    def echo(self) -> Echo:
        """Whether the line gives our own requests back."""
        return self._wire.echo

    def status(self, now: float) -> LineStatus:
        """The line at `now`."""
        refresh = [
            r.device.stats.refresh_s for r in self._records.values() if r.state is DeviceState.ONLINE and not r.night
        ]
        known = [refresh_s for refresh_s in refresh if refresh_s is not None]
        stretch = max(1.0, sum(known) / len(known) / self.settings.poll.live_s) if known else 1.0
        use = self._accounting.use_ratio(now)
        echo = self._wire.echo.value
        return LineStatus(self._state, self._state_since, self._error, len(self._scheduler), use, stretch, echo)

    def opened(self, now: float) -> None:
        """The port is open: everything is read anew, quarantined devices are probed at once."""
        self._set_state(LineState.OPEN, "", now)
        self.stats.opens += 1
        self._wire.reset(now)
        for record in self._records.values():
            record.breaker.line_opened(now)
            self._polling.restart(record, now)
        self._scheduler.polls_changed()

    def closed(self, error: str, now: float) -> None:
        """The port is closed: what waited ends with LineDown, or by rule 9; online devices become stale."""
        self._set_state(LineState.DOWN, error, now)
        reason = ShuttingDown() if self._finishing else LineDown(error)
        self._wire.reset(now)
        for turn, sent_at in self._under_way.clear():
            self._records[turn.device.unit_id].doubt.missed(turn.pdu[0])
            self._accounting.ended(turn, sent_at, now, "line_down")
            self._finish(waiters_of(turn), Unconfirmed(error) if isinstance(turn, WriteTurn) else reason)
        for turn in self._aside.clear():
            self._finish(waiters_of(turn), reason)
        self._finish(self._scheduler.drain(), reason)
        self._scheduler.polls_changed()
        for record in self._records.values():
            if record.state is DeviceState.ONLINE:
                self._change(record, DeviceState.STALE, now, reason=STOPPING if self._finishing else "line down")

    def read(
        self, device: Device, pdu: bytes, done: Callable[[Outcome], None], now: float, *, client: str, lane: Lane
    ) -> Waiter:
        """Queue a read; `done` is called by a later `step`, exactly once."""
        waiter = Waiter(done, client, now)
        try:
            self._check(device)
            span = span_of(device, pdu)
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
            if self._wire.echo is Echo.UNKNOWN:
                raise EchoUnknown("nothing was read on this line yet")
            point = written_point(device, pdu)
            lane = Lane.SLAVE_CONTROL if point is not None and point.rewrite_s is not None else Lane.WRITE
            self._scheduler.add_write(WriteTurn(device, pdu, lane, now, waiter))
        except RequestError as error:
            self._finish([waiter], error)
        return waiter

    @property
    def is_open(self) -> bool:
        """Whether the line is open."""
        return self._state is LineState.OPEN

    def due(self, now: float) -> bool:
        """Whether something could begin now, if the wire let it."""
        if self._finishing or self._state is LineState.DOWN or self._aside.blocks():
            return False
        if self._aside.due():
            return True
        due = self._scheduler.next_due(now)
        return due is not None and due <= now

    @property
    def busy(self) -> bool:
        """Whether a transaction is under way."""
        return bool(self._under_way)

    def adjust(self, settings: LineSettings, now: float) -> None:
        """Go on by other settings of the same wire (`LineSettings.same_wire`)."""
        self.settings = settings
        self._polling.adjust(settings, self._records.values(), now)
        self._scheduler.polls_changed()
        self._scheduler.adjust(limit=settings.queue_limit, limit_s=settings.queue_limit_s)

    def finish(self) -> None:
        """Begin nothing more (rule 9)."""
        self._finishing = True

    def receive(self, data: bytes, now: float) -> None:
        """Bytes came from the line."""
        if self._state is LineState.DOWN:
            return
        self._ended(self._wire.receive(data, now), now)

    def on_timer(self, now: float) -> None:
        """A deadline may have passed."""
        self._ended(self._wire.on_timer(now), now)
        expired = self._scheduler.expired(now)
        if expired:
            self._finish(expired, QueueTimeout(f"waited {self.settings.queue_limit_s:g} s"))
        self._rewrites.watch(now)

    def step(self, now: float) -> bytes | None:
        """Hand out outcomes, then give the frame to write now, or None."""
        if self._finishing:
            self._finish(self._scheduler.drain(), ShuttingDown())
            for waiting in self._aside.clear():
                self._finish(waiters_of(waiting), ShuttingDown())
        if self._outcomes:
            self._outcomes.hand_out()
        if self._state is LineState.DOWN or self._wire.ready_at(now) > now:
            return None
        turn = self._next(now)
        if turn is None:
            return None
        timeout_s = turn.device.reply_timeout_s or self.settings.reply_timeout_s
        try:
            key, frame = self._wire.send(turn.device.address, turn.pdu, now, timeout_s)
        except RequestError as error:  # a client's PDU that has no meaning on a serial line
            if isinstance(turn, PollItem):
                raise
            self._finish(waiters_of(turn), error)
            return self.step(now)
        record = self._records[turn.device.unit_id]
        self._under_way.add(key, turn, now, closed=record.breaker.is_open, alone=self._aside.is_alone(turn))
        self._aside.begun(turn)
        self._begun(turn, now)
        self._accounting.sent(turn, now)
        return frame

    def bytes_due(self) -> int:
        """How many bytes of the awaited reply are at least still to come."""
        return self._wire.bytes_due()

    def next_deadline(self, now: float) -> float | None:
        """When the shell must call `on_timer` and `step` again; None: only after an input."""
        if self._outcomes:
            return now
        if self._state is LineState.DOWN:
            return None
        wire_at = self._wire.next_deadline()
        if self._finishing:  # polls are due, and nobody will make them
            return wire_at
        moments = [wire_at, self._scheduler.next_expiry(), *self._rewrites.moments()]
        ready_at = self._wire.ready_at(now)
        if ready_at not in {math.inf, wire_at} and not self._aside.blocks():  # else the wire comes first
            due = now if self._aside.due() else self._scheduler.next_due(now)
            moments.append(None if due is None else max(due, ready_at))
        return min([moment for moment in moments if moment is not None], default=None)

    def _check(self, device: Device) -> None:
        """Raise why nothing can be asked of this device now."""
        record = self._records[device.unit_id]
        if self._finishing:
            raise ShuttingDown
        if self._state is LineState.DOWN:
            raise LineDown(self._error)
        if record.breaker.is_open:
            raise DeviceOffline(device.name)
        if not record.verified and (record.known.expects or IDENTITY_MISMATCH in device.snapshot.warnings):
            raise IdentityUnproven(device.name)

    def _next(self, now: float) -> Turn | None:
        """The turn to make now, or the settling question that must be answered before it (rule 7)."""
        if self._finishing or self._aside.blocks():
            return None
        turn = self._aside.first() or self._scheduler.next(now)
        if turn is None:
            return None
        record = self._records[turn.device.unit_id]
        if record.doubt.allows(turn.pdu[0]):
            return turn
        self._aside.hold(turn)
        return self._polling.settling(record, now)

    def _begun(self, turn: Turn, now: float) -> None:
        if isinstance(turn, PollItem):
            self._polling.started(turn, self._records[turn.device.unit_id], now)
        elif isinstance(turn, ReadTurn):
            for read in turn.reads:
                read.attempts += 1

    def _ended(self, ended: Iterable[Ended], now: float) -> None:
        """Transactions that the wire ended."""
        for key, event in ended:
            turn, sent_at = self._under_way.end(key)
            record = self._records[turn.device.unit_id]
            record.asked_at = sent_at
            error = event.error if isinstance(event, Failed) else self._relayed(event.pdu)
            failed = None if error is None else error.label
            if isinstance(event, Replied) and event.pdu[0] >= EXCEPTION_BIT:
                turn.device.stats.exceptions += 1
                failed = "exception"
            seconds = self._accounting.ended(turn, sent_at, now, failed)
            if error is not None:
                record.doubt.missed(turn.pdu[0])
                blameless = isinstance(event, Failed) and event.blameless and not record.breaker.is_open
                if blameless and self._aside.again(turn):
                    self._scheduler.polls_changed()
                    continue
                self._on_no_reply(turn, record, error, now)
            else:
                assert isinstance(event, Replied)
                self._on_reply(turn, record, event, now)
            self._aside.forget(turn)
            if isinstance(turn, ReadTurn):
                self._scheduler.charge(turn, seconds)
            if error is None and type(turn) is ReadTurn and record.state is DeviceState.ONLINE:
                continue  # a good answer to a client changes nothing else
            self._judge(record, now)
            self._scheduler.polls_changed()
        self._news.quarantine(self._wire.quarantine_s(now))

    def _relayed(self, pdu: bytes) -> RequestError | None:
        """What rule 11 makes of a reply."""
        if pdu[0] < EXCEPTION_BIT or not self._wire.relays or pdu[1] not in _RELAYED:
            return None
        return _RELAYED[pdu[1]]("an upstream gateway says so")

    def _on_no_reply(self, turn: Turn, record: DeviceRecord, error: RequestError, now: float) -> None:
        if turn.purpose is Purpose.SETTLE:
            self._on_unsettled(turn, record, error, now)
        else:
            self._on_failure(turn, record, error, now)

    def _on_reply(self, turn: Turn, record: DeviceRecord, event: Replied, now: float) -> None:
        record.doubt.answered(turn.pdu[0])
        self._heard(record, now)
        if isinstance(turn, PollItem):
            if turn.purpose is Purpose.SETTLE:
                record.heard(now)
                self._aside.settled(turn)
                return
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
        else:
            self._on_read(turn, record, event)

    def _on_read(self, turn: ReadTurn, record: DeviceRecord, event: Replied) -> None:
        if not is_exception(event.pdu):
            for read in turn.reads:
                self._finish(read.waiters, part_of(turn, read, event.pdu))
        elif len(turn.reads) > 1:
            if turn.span is not None and event.pdu[1] in _REFUSALS:
                record.polls.refused(turn.span.space, turn.span.count)
            for read in reversed(turn.reads):
                read.alone = True
                self._scheduler.retry(read)
        elif self._puts_off(turn, event.pdu):
            turn.reads[0].put_off = True
            self._scheduler.retry(turn.reads[0])
        else:
            self._finish(turn.reads[0].waiters, event.pdu)

    def _on_failure(self, turn: Turn, record: DeviceRecord, error: RequestError, now: float) -> None:
        silent = isinstance(error, ReplyTimeout) and not isinstance(error, RelayedNoPath)
        if isinstance(turn, WriteTurn):
            point = written_point(turn.device, turn.pdu)
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
                final = record.breaker.is_open or isinstance(error, RelayedSilence)
                if final or read.attempts > self.settings.retries or not read.wanted:
                    self._finish(read.waiters, error)
                else:
                    self._scheduler.retry(read)

    def _on_unsettled(self, question: Turn, record: DeviceRecord, error: RequestError, now: float) -> None:
        """The settling question failed, and with it the turn that was held for it (rule 7)."""
        turn = self._aside.unsettled(question)
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
        elif (
            now >= record.restarting_until
            and not optional
            and not self._wire.silent
            and (record.asked_at >= record.missed_at)
        ):
            record.missed_at = now  # what was under way together counts once
            no_path = isinstance(error, RelayedNoPath)  # asking costs the upstream's line nothing
            record.breaker.missed(now, FIRST_PROBE_S if no_path else LAST_PROBE_S)

    def _puts_off(self, turn: ReadTurn, pdu: bytes) -> bool:
        return pdu[1] == _BUSY and self.settings.retries > 0 and not turn.reads[0].put_off

    def _written(self, turn: WriteTurn, record: DeviceRecord, now: float) -> None:
        """A write was, or may have been, taken: forget the old value and watch what must be rewritten."""
        space = turn.device.map.write_functions[turn.pdu[0]]
        address = int.from_bytes(turn.pdu[1:3], "big")
        self._polling.wanted_again(record, space, address, now)
        point = written_point(turn.device, turn.pdu)
        if point is None or point.rewrite_s is None:
            return
        self._rewrites.written(record, point, int.from_bytes(turn.pdu[3:5], "big"), now)

    def _heard(self, record: DeviceRecord, now: float) -> None:
        """The device is there; after a quarantine everything is read anew."""
        record.restarting_until = 0.0
        if record.breaker.is_open:
            self._polling.restart(record, now)
        record.breaker.replied()

    def _judge(self, record: DeviceRecord, now: float) -> None:
        state = self._polling.judge(record, now)
        if state is record.state:
            return
        self._change(record, state, now, reason="silent" if state is DeviceState.OFFLINE else "")
        if state is DeviceState.OFFLINE:
            record.device.stats.went_offline += 1
            self._finish(self._scheduler.drain(record.device), DeviceOffline(record.device.name))

    def _change(self, record: DeviceRecord, state: DeviceState, now: float, reason: str) -> None:
        before = record.state
        self._news.device(record.device, before, record.become(state, now), reason)

    def _set_state(self, state: LineState, error: str, now: float) -> None:
        if state is not self._state:
            self._state_since = now
        self._state = state
        self._error = error
