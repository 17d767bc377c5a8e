"""The line engine: one owner of a line, sans-IO, with time as an argument.

Rule 1: one transaction at a time; the next request goes out only when the RTU client says so (gap kept,
        quarantine over) and the scheduler says whose turn it is.
Rule 2: a device is online once each of its live blocks was read since the line was opened or the device
        came back, and while none was missed three times in a row; stale when one was, or when the line is
        down; offline from the moment its breaker opens until it is online again.
Rule 3: a client's read is tried `retries` times more, a poll waits for its next turn instead.
Rule 4: a poll refused with exception 02 or 03 is split in two and the split is remembered.
Rule 5: nothing but functions 01 to 04 and 2B/0E is ever sent.

The shell calls `opened`, `closed`, `receive`, `on_timer` and `submit`, then `step` until it returns None,
writing what it returns, and comes back at `next_deadline`. Outcomes are handed out by `step` only.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Sequence
from random import Random

from gateway.core.device_record import DeviceRecord
from gateway.core.health import MISSES_TO_OPEN, Breaker
from gateway.core.scheduler import ClientRead, Job, PollItem, PollList, Purpose, Scheduler, Waiter
from gateway.core.settings import LineSettings
from gateway.core.site import Device, LineState, LineStatus, Outcome
from gateway.core.snapshot import Block, DeviceState
from gateway.core.stats import LineStats
from gateway.core.usage import UseMeter
from gateway.devices.model import Identification, PollClass, Space
from gateway.devices.plan import PlannedBlock, poll_plan, split
from gateway.errors import DeviceOffline, IllegalFunction, LineDown, QueueTimeout, ReplyTimeout, RequestError
from gateway.modbus.pdu import (
    Function,
    ReadRequest,
    is_exception,
    parse_identification,
    read_identification_request,
)
from gateway.modbus.rtu import Failed, Replied, RtuClient, State

log = logging.getLogger(__name__)

READ_FUNCTIONS = frozenset(
    {
        Function.READ_COILS,
        Function.READ_DISCRETE_INPUTS,
        Function.READ_HOLDING_REGISTERS,
        Function.READ_INPUT_REGISTERS,
        Function.READ_IDENTIFICATION,
    }
)
_REFUSALS_TO_SPLIT = (0x02, 0x03)


class LineEngine:
    """Polls and client reads of one line."""

    def __init__(self, settings: LineSettings, devices: Sequence[Device], now: float, rng: Random) -> None:
        self.settings = settings
        self.stats = LineStats()
        self._rtu = RtuClient(settings.timing(), self.stats.wire, quarantine_s=settings.quarantine_s)
        self._records = {
            device.unit_id: DeviceRecord(device, PollList(device, Breaker(rng), self._first_polls(device, now)), now)
            for device in devices
        }
        self._scheduler = Scheduler(
            [record.polls for record in self._records.values()],
            limit=settings.queue_limit,
            limit_s=settings.queue_limit_s,
        )
        self._job: Job | None = None
        self._sent_at = now
        self._finished: deque[tuple[Waiter, Outcome]] = deque()
        self._state = LineState.DOWN
        self._state_since = now
        self._error = "not opened yet"
        self._use = UseMeter(now)

    def status(self, now: float) -> LineStatus:
        """The line at `now`."""
        return LineStatus(self._state, self._state_since, self._error, len(self._scheduler), self._use.ratio(now))

    def opened(self, now: float) -> None:
        """The port is open: everything that is due is read, quarantined devices are probed at once."""
        self._set_state(LineState.OPEN, "", now)
        self.stats.opens += 1
        self._rtu.reset(now)
        for record in self._records.values():
            record.breaker.line_opened(now)
            self._restart_polls(record, now)

    def closed(self, error: str, now: float) -> None:
        """The port is closed: what waited ends with LineDown, online devices become stale."""
        self._set_state(LineState.DOWN, error, now)
        self._rtu.reset(now)
        if self._job is not None:
            job, self._job = self._job, None
            self._account(now, failed="line_down")
            if isinstance(job, ClientRead):
                self._finish(job, LineDown(error))
        for read in self._scheduler.drain():
            self._finish(read, LineDown(error))
        for record in self._records.values():
            if record.state is DeviceState.ONLINE:
                self._change(record, DeviceState.STALE, now, reason="line down")

    def submit(self, device: Device, pdu: bytes, done: Callable[[Outcome], None], now: float) -> Waiter:
        """Queue a client's read; `done` is called by a later `step`, exactly once."""
        record = self._records[device.unit_id]
        waiter = Waiter(done)
        if not pdu or pdu[0] not in READ_FUNCTIONS:
            self._finished.append((waiter, IllegalFunction("only reads are sent")))
        elif self._state is LineState.DOWN:
            self._finished.append((waiter, LineDown(self._error)))
        elif record.breaker.is_open:
            self._finished.append((waiter, DeviceOffline(device.name)))
        else:
            try:
                self._scheduler.add(device, pdu, waiter, now)
            except RequestError as error:
                self._finished.append((waiter, error))
        return waiter

    def receive(self, data: bytes, now: float) -> None:
        """Bytes came from the line."""
        if self._state is LineState.DOWN:
            return
        event = self._rtu.receive(data, now)
        if event is not None:
            self._on_event(event, now)

    def on_timer(self, now: float) -> None:
        """A deadline may have passed."""
        event = self._rtu.on_timer(now)
        if event is not None:
            self._on_event(event, now)
        for read in self._scheduler.expired(now):
            self._finish(read, QueueTimeout(f"waited {self.settings.queue_limit_s:g} s"))

    def step(self, now: float) -> bytes | None:
        """Hand out outcomes, then give the frame to write now, or None."""
        while self._finished:
            waiter, outcome = self._finished.popleft()
            try:
                waiter.finish(outcome)
            except Exception:  # the edge to a face: its mistake must not stop the line
                log.exception("event=outcome_handler_failed line=%s", self.settings.name)
        if self._state is LineState.DOWN or self._job is not None or self._rtu.ready_at(now) > now:
            return None
        job = self._scheduler.next(now)
        if job is None:
            return None
        try:
            frame = self._rtu.send(job.device.address, job.pdu, now, self.settings.reply_timeout_s)
        except RequestError as error:  # a client's PDU that has no meaning on a serial line
            if isinstance(job, ClientRead):
                self._finish(job, error)
                return self.step(now)
            raise
        self._sent(job, now)
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
        moments = [self._rtu.next_deadline(), self._scheduler.next_expiry()]
        if self._job is None and self._rtu.state is State.IDLE:
            due = self._scheduler.next_due(now)
            moments.append(None if due is None else max(due, self._rtu.ready_at(now)))
        return min((moment for moment in moments if moment is not None), default=None)

    def _first_polls(self, device: Device, now: float) -> list[PollItem]:
        """The plan, and what is asked once."""
        poll = self.settings.poll
        period_s = {PollClass.LIVE: poll.live_s, PollClass.SETTINGS: poll.settings_s}
        blocks = [_poll_item(device, block, period_s[block.poll], now) for block in poll_plan(device.map)]
        return sorted(blocks + self._once(device, now), key=_rank)

    def _once(self, device: Device, now: float) -> list[PollItem]:
        """What is asked once after each start: who are you."""
        items = [PollItem(device, Purpose.IDENTIFY, read_identification_request(), None, None, now)]
        if device.map.identity.serial_first is not None:
            function = device.map.read_function(Space.REGISTERS)
            request = ReadRequest(function, device.map.identity.serial_first, device.map.identity.serial_words)
            items.append(PollItem(device, Purpose.SERIAL_NUMBER, request.encode(), None, None, now))
        return items

    def _restart_polls(self, record: DeviceRecord, now: float) -> None:
        """Everything is read anew; blocks that were split stay split."""
        items = [item for item in record.polls.items if item.block is not None]
        for item in items:
            item.restart(now)
        record.polls.items = sorted(items + self._once(record.device, now), key=_rank)

    def _sent(self, job: Job, now: float) -> None:
        self._job = job
        self._sent_at = now
        self.stats.sent += 1
        if isinstance(job, ClientRead):
            job.attempts += 1
            self.stats.client_reads += 1
            self.stats.retries += job.attempts > 1
        else:
            self.stats.polls += 1
            job.device.stats.polls += 1
            if job.period_s is not None:
                job.due = now + job.period_s

    def _on_event(self, event: Replied | Failed, now: float) -> None:
        job, self._job = self._job, None
        assert job is not None, "the RTU client reports only what was sent"
        record = self._records[job.device.unit_id]
        if isinstance(event, Failed):
            self._account(now, failed=event.error.label)
            self._on_failure(job, record, event.error, now)
            return
        self._heard(record, now)
        exception = is_exception(event.pdu)
        self._account(now, failed="exception" if exception else None)
        job.device.stats.exceptions += exception
        if isinstance(job, ClientRead):
            record.heard(now)
            self._finish(job, event.pdu)
        elif exception:
            self._on_poll_exception(job, record, event.pdu[1], now)
        else:
            self._on_poll_reply(job, record, event, now)
        self._judge(record, now)

    def _on_poll_reply(self, item: PollItem, record: DeviceRecord, event: Replied, now: float) -> None:
        item.misses = 0
        if item.block is not None:
            block = item.block
            item.fresh = True
            record.store(Block(block.space, block.first, block.count, event.pdu[2:], event.sent_at), now)
        elif item.purpose is Purpose.IDENTIFY:
            record.polls.items.remove(item)
            objects = parse_identification(event.pdu).objects
            vendor, product, revision = (
                objects.get(number, b"").decode("ascii", "replace").strip("\0 ") for number in range(3)
            )
            record.identified(Identification(vendor, product, revision), now)
        else:
            record.polls.items.remove(item)
            record.numbered(_printable(event.pdu[2:]), now)

    def _on_poll_exception(self, item: PollItem, record: DeviceRecord, code: int, now: float) -> None:
        record.heard(now)
        if item.block is None:
            record.polls.items.remove(item)  # the device does not have it: asked once, no failure
            return
        item.misses += 1
        item.device.stats.failures += 1
        if code not in _REFUSALS_TO_SPLIT:
            return
        block = item.block
        record.polls.items.remove(item)
        record.drop((block.space, block.first, block.count))
        halves = split(block, item.device.map)
        log.info(
            "event=block_refused device=%s space=%s first=0x%04X count=%d exception=%02X action=%s",
            item.device.name,
            block.space,
            block.first,
            block.count,
            code,
            "dropped" if halves is None else "split",
        )
        if halves is not None and item.period_s is not None:
            record.polls.items += [_poll_item(item.device, half, item.period_s, now) for half in halves]

    def _on_failure(self, job: Job, record: DeviceRecord, error: RequestError, now: float) -> None:
        job.device.stats.failures += 1
        optional = isinstance(job, PollItem) and job.purpose is Purpose.SERIAL_NUMBER
        if isinstance(error, ReplyTimeout):
            if not optional:
                record.breaker.missed(now)
        else:
            self._heard(record, now)  # it speaks, if not clearly
        if isinstance(job, PollItem):
            job.misses += 1
            if job.period_s is None:
                job.due = now + self.settings.poll.live_s
                if job.misses >= MISSES_TO_OPEN or optional:
                    record.polls.items.remove(job)
        elif record.breaker.is_open or job.attempts > self.settings.retries or not job.wanted:
            self._finish(job, error)
        else:
            self._scheduler.retry(job)
        self._judge(record, now)

    def _heard(self, record: DeviceRecord, now: float) -> None:
        """The device is there; after a quarantine everything is read anew."""
        if record.breaker.is_open:
            self._restart_polls(record, now)
        record.breaker.replied()

    def _judge(self, record: DeviceRecord, now: float) -> None:
        """Rule 2: the state that follows from breaker and live blocks."""
        live = [item for item in record.polls.items if item.block is not None and item.block.poll is PollClass.LIVE]
        state = record.state
        if record.breaker.is_open:
            state = DeviceState.OFFLINE
        elif state is DeviceState.ONLINE and any(item.misses >= MISSES_TO_OPEN for item in live):
            state = DeviceState.STALE
        elif live and all(item.fresh and item.misses == 0 for item in live):
            state = DeviceState.ONLINE
        if state is record.state:
            return
        self._change(record, state, now, reason="silent" if state is DeviceState.OFFLINE else "")
        if state is DeviceState.OFFLINE:
            record.device.stats.went_offline += 1
            for read in self._scheduler.take_device(record.device):
                self._finish(read, DeviceOffline(record.device.name))

    def _change(self, record: DeviceRecord, state: DeviceState, now: float, reason: str) -> None:
        before = record.state
        lasted_s = record.become(state, now)
        level = logging.INFO if state is DeviceState.ONLINE else logging.WARNING
        log.log(
            level,
            "event=device_%s line=%s device=%s address=%d before=%s lasted_s=%.1f%s",
            state,
            self.settings.name,
            record.device.name,
            record.device.address,
            before,
            lasted_s,
            f' reason="{reason}"' if reason else "",
        )

    def _account(self, now: float, failed: str | None) -> None:
        self.stats.busy_s += now - self._sent_at
        self._use.add(self._sent_at, now)
        if failed is None:
            self.stats.ok += 1
        else:
            self.stats.failed[failed] += 1

    def _finish(self, read: ClientRead, outcome: Outcome) -> None:
        self._finished.extend((waiter, outcome) for waiter in read.waiters)

    def _set_state(self, state: LineState, error: str, now: float) -> None:
        if state is not self._state:
            self._state_since = now
        self._state = state
        self._error = error


def _poll_item(device: Device, block: PlannedBlock, period_s: float, due: float) -> PollItem:
    request = ReadRequest(device.map.read_function(block.space), block.first, block.count)
    return PollItem(device, Purpose.POLL, request.encode(), block, period_s, due)


def _rank(item: PollItem) -> int:
    """Order of the first round: values on every face soon after start matter more than names."""
    if item.block is not None:
        return 0 if item.block.poll is PollClass.LIVE else 2
    return 1 if item.purpose is Purpose.IDENTIFY else 3


def _printable(words: bytes) -> str:
    """Registers as ASCII text; "" when they hold anything else (the number is undocumented)."""
    text = words.strip(b"\0\xff ")
    return text.decode("ascii") if text.isascii() and text.decode("ascii", "replace").isprintable() else ""
