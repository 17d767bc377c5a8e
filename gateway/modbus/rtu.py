"""The RTU client of one line: one request at a time, and no answer but its own.

Bytes and the time go in, a request's end comes out; nothing here reads a clock or a port. Times are
monotonic seconds.

    IDLE ──send──▶ WAITING ──reply──▶ IDLE
                      │ └── first reply after a missed one ──▶ QUARANTINED
                      └── failure ──▶ QUARANTINED ──silence──▶ IDLE

Rule 1, the gap: a request goes out no sooner than 3.5 characters after the last byte that was received or the
    computed end of our own transmission (Serial Line V1.02, §2.5.1.1).
Rule 2, the deadline: end of our transmission + time-out + wire time of the longest reply that can answer.
    Nothing but the reply ends the wait sooner, and nothing prolongs it: bytes of others do not. A reply handed in
    after the deadline, but before `on_timer` ended the transaction, still counts: it was the loop that was late.
Rule 3, the reply: right address, function (or its exception), exact size, shape and CRC, at any offset
    (frames.py, collector.py). Frames of other units, echoes and noise are counted and do not matter.
Rule 4, a frame of the right address that does not answer the request is most often a late reply to an earlier
    one, and the right one may follow. So it never ends the transaction: the deadline does, with ReplyMismatch.
Rule 5, the exception to rule 2: a reply of full size with a wrong CRC ends the transaction with ReplyCrcError as
    soon as the line has been silent for longer than adapters hold bytes back. A device answers once, nothing
    better will come. A damaged reply that cannot be told from noise for sure waits for the deadline.
Rule 6, quarantine: after a failure the line must be silent for the window (quarantine.py), counted from the
    failure or the last byte after it. Bytes that come while nobody waits are late, and never looked at.
Rule 7, probation: the first reply of a device after one that never came may be the missed one, and its own still
    under way. It is delivered, for rule 3 let it pass, but the line is quarantined once more, so that the other
    one cannot answer the next request.
Rule 8, stragglers: a frame of rule 4, or bytes that come when a quarantine after a failure (or a probation) has
    ended or confirms that two replies were under way, tell that the window is too short.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

from gateway.errors import ReplyCrcError, ReplyMismatch, ReplyTimeout, RequestError
from gateway.modbus.collector import Collector, Echo
from gateway.modbus.counters import RtuCounters
from gateway.modbus.frames import Exchange, Survey
from gateway.modbus.quarantine import QuarantineWindow
from gateway.modbus.transactions import Failed, Replied

ADAPTER_HOLD_S = 0.02
"""USB adapters hand bytes over in batches of up to 16 ms; a longer pause is the line's."""


class State(Enum):
    """What the line is doing."""

    IDLE = "idle"
    WAITING = "waiting"
    QUARANTINED = "quarantined"


@dataclass(frozen=True, slots=True)
class Timing:
    """How long things take on a line."""

    char_s: float
    gap_s: float  # 3.5 characters, 1.75 ms above 19200 baud (Serial Line §2.5.1.1)

    @classmethod
    def of(cls, baudrate: int, bytesize: int, parity: str, stopbits: float) -> Timing:
        """Timing of a serial setting; parity "N" is none, every other letter adds a bit."""
        char_s = (1 + bytesize + (parity != "N") + stopbits) / baudrate
        return cls(char_s, 0.00175 if baudrate > 19200 else 3.5 * char_s)

    def wire_s(self, n_bytes: int) -> float:
        """Seconds that `n_bytes` take on the wire."""
        return n_bytes * self.char_s


@dataclass(slots=True)
class _Transaction:
    """The request on the wire; times as the rules say, infinite `settle_at` when rule 5 has nothing to look at."""

    collector: Collector
    sent_at: float
    timeout_s: float
    deadline: float
    settle_at: float = math.inf


class RtuClient:
    """The state machine of one line; see the rules of this module.

    The shell's moves: wait until `ready_at`, write what `send` returns, hand every read to `receive`, call
    `on_timer` at `next_deadline`, call `reset` when the port was opened. `echo` tells whether the line gives our
    requests back.
    """

    def __init__(self, timing: Timing, counters: RtuCounters, *, quarantine_s: float) -> None:
        self._timing = timing
        self._counters = counters
        self._window = QuarantineWindow(max(quarantine_s, timing.gap_s))
        self._transaction: _Transaction | None = None
        self._state = State.IDLE
        self._quiet_from = -math.inf  # the last byte on the line, received or sent
        self._until = -math.inf  # end of the quarantine
        self._failed = False  # the last transaction
        self._overdue = False  # bytes that come now are stragglers
        self._missed: set[int] = set()  # addresses with a reply that never came
        self.echo = Echo.UNKNOWN

    @property
    def state(self) -> State:
        """The state after the last call; a quarantine ends by a call with its time, such as `on_timer`."""
        return self._state

    def quarantine_s(self, now: float) -> float:
        """How long the line must be silent after a failure, as learnt (rule 8)."""
        return self._window.seconds(now)

    def ready_at(self, now: float) -> float:
        """The earliest time from `now` on at which the next request may go out; infinite while waiting."""
        if self._transaction is not None:
            return math.inf
        self._advance(now)
        until = self._until if self._state is State.QUARANTINED else self._quiet_from + self._timing.gap_s
        return max(now, until)

    def send(self, address: int, pdu: bytes, now: float, timeout_s: float) -> bytes:
        """Start a transaction and return the frame, to be written at once.

        `timeout_s` counts from the end of our transmission to the first byte that is due. Raises ValueError for
        an address out of 1..247, IllegalFunction, IllegalDataValue or IllegalDataAddress for a PDU we do not
        speak, RuntimeError before `ready_at`. None of them changes anything.
        """
        exchange = Exchange.of(address, pdu)
        if self.ready_at(now) > now:
            raise RuntimeError("the line is not free: wait until ready_at")
        self._quiet_from = now + self._timing.wire_s(len(exchange.sent))
        self._transaction = _Transaction(
            collector=Collector(exchange, self.echo),
            sent_at=now,
            timeout_s=timeout_s,
            deadline=self._quiet_from + timeout_s + self._timing.wire_s(exchange.longest_reply),
        )
        self._state = State.WAITING
        self._overdue = False
        return exchange.sent

    def receive(self, data: bytes, now: float) -> Replied | Failed | None:
        """Take bytes that the line gave; returns the end of the transaction when they bring it."""
        if not data:
            return None
        self._quiet_from = max(self._quiet_from, now)
        transaction = self._transaction
        if transaction is None:
            self._take_late(len(data), now)
            return None
        reply = transaction.collector.take(data)
        if reply is None:
            transaction.settle_at = now + self._timing.gap_s + ADAPTER_HOLD_S
            return None
        pdu, trailing = reply
        self._counters.late_bytes += trailing
        self._succeed(transaction.collector, now)
        return Replied(pdu, transaction.sent_at, now)

    def bytes_due(self) -> int:
        """How many more bytes are expected at least before something can happen; 0 when nobody waits.

        A hint for how long to leave the port alone. Noise that looks like a reply's head makes it too large: read
        whatever is there before `on_timer`.
        """
        return 0 if self._transaction is None else self._transaction.collector.bytes_due()

    def next_deadline(self) -> float | None:
        """When `on_timer` has something to do; None when only bytes or a request can change anything."""
        if self._transaction is not None:
            return min(self._transaction.deadline, self._transaction.settle_at)
        return self._until if self._state is State.QUARANTINED else None

    def on_timer(self, now: float) -> Replied | Failed | None:
        """Let time pass: ends a transaction by rule 2 or 5, a quarantine by rule 6; harmless when early."""
        transaction = self._transaction
        if transaction is None:
            self._advance(now)
            return None
        if now >= transaction.deadline:
            return self._fail(transaction, now)
        if now >= transaction.settle_at:
            if transaction.collector.damaged():
                return self._fail(transaction, now)
            transaction.settle_at = math.inf
        return None

    def reset(self, now: float) -> None:
        """The port was opened: forget the transaction and what was known of the line, and listen for a window.

        A request that was on the wire ends without an event; its owner knows that the port went away.
        """
        self._transaction = None
        self._missed.clear()
        self._failed = self._overdue = False
        self.echo = Echo.UNKNOWN
        self._quiet_from = now
        self._quarantine(now)

    def _take_late(self, n_bytes: int, now: float) -> None:
        self._advance(now)
        self._counters.late_bytes += n_bytes
        if self._overdue:
            self._overdue = False
            self._window.straggler(now)
        if self._state is State.QUARANTINED:
            self._quarantine(now)

    def _succeed(self, collector: Collector, now: float) -> None:
        self._account(collector.seen, now)
        self.echo = collector.echo_after(replied=True)
        self._transaction = None
        self._failed = False
        address = collector.exchange.address
        if address in self._missed:
            self._missed.discard(address)
            self._overdue = True
            self._quarantine(now)
        else:
            self._state = State.IDLE

    def _fail(self, transaction: _Transaction, now: float) -> Failed:
        collector = transaction.collector
        seen = collector.close()
        self._account(seen, now)
        self.echo = collector.echo_after(replied=False)
        self._transaction = None
        self._failed = True
        self._quarantine(now)
        address = collector.exchange.address
        error: RequestError
        if seen.damaged or seen.maybe_damaged:
            error = ReplyCrcError(f"reply of address {address} with a wrong CRC")
        else:
            self._missed.add(address)
            if seen.mismatch:
                error = ReplyMismatch(f"address {address} answered something else than it was asked")
            else:
                error = ReplyTimeout(f"no reply of address {address} within {transaction.timeout_s:g} s")
        return Failed(error, transaction.sent_at, now)

    def _account(self, seen: Survey, now: float) -> None:
        counters = self._counters
        counters.noise_bytes += seen.noise_bytes
        counters.wrong_unit += seen.wrong_unit
        counters.mismatch += seen.mismatch
        counters.crc_errors += seen.damaged + seen.maybe_damaged
        counters.echoes += seen.echoes
        if seen.mismatch:
            self._window.straggler(now)

    def _quarantine(self, now: float) -> None:
        self._state = State.QUARANTINED
        self._until = now + self._window.seconds(now)

    def _advance(self, now: float) -> None:
        if self._state is State.QUARANTINED and now >= self._until:
            self._state = State.IDLE
            self._overdue = self._overdue or self._failed
