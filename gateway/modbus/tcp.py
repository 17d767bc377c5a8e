"""The Modbus TCP client of one upstream: several requests under way, and no answer but their own.

Bytes and the time go in, the ends of requests come out; nothing here opens a connection or reads a clock. Times are
monotonic seconds.

    UNCONNECTED ──connected──▶ CONNECTED ──lost──▶ UNCONNECTED
                                   └── `drop` is not None: the shell ends the connection and calls `lost`

Rule 1, the reply: it has the transaction id, unit id and function (or its exception) of its request, and the exact
    shape (pdu.py). Anything else, another protocol id, a length that no ADU has, or bytes that cannot begin a reply
    to anybody mean that the stream cannot be trusted: the connection is dropped, and nothing more is taken from it,
    nor what came with those bytes: a reply that lost its end is made whole by the head of the next.
Rule 2, transaction ids: none is used twice on a connection while a reply to it may still come. Those of requests that
    were given up are retired for as long as the connection lives; a late reply to one is counted and thrown away.
Rule 3, the time-out counts from the request to its whole reply. When a request that went out later was answered
    meanwhile, only the one is given up. Otherwise nothing tells a slow server from a dead connection: it is dropped.
Rule 4: what was under way on a connection that is lost ends with ConnectionLost. It is blameless when others were
    under way too, or when the connection had answered before: then it was the connection, not the request. So is a
    time-out in company. A request that is alone has nobody to blame but itself.
Rule 5, silence: a server is `silent` when three connections in a row ended by a time-out without a single reply, and
    requests to more than one unit were among them. Then it stays so from one connection to the next until it answers.
Rule 6, company: how many may be under way at once is learnt (pipelining.py). The first request of a connection is
    always alone.
Rule 7, servers that close after every reply: after two connections that the other end closed with one reply each, a
    connection is taken for one request: after its reply nothing goes out into it, and we end it ourselves if the other
    end has not done so within 50 ms. Every ten minutes one is used on, to see whether that still holds.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from gateway.errors import ConnectionLost, ReplyMismatch, ReplyTimeout, RequestError
from gateway.modbus.collector import Echo
from gateway.modbus.counters import RtuCounters, UpstreamCounters
from gateway.modbus.mbap import Adu, MbapSplitter, encode
from gateway.modbus.pdu import expected_reply_size, reply_fits
from gateway.modbus.pipelining import Window
from gateway.modbus.transactions import Ended, Failed, Replied

FINISHED = ""
"""`drop` when the connection is to be ended although nothing is wrong with it (rule 7)."""
ONE_REPLY_TIMES = 2
CLOSES_WITHIN_S = 0.05
LOOK_AGAIN_S = 600.0
MOST_RETIRED = 1024
SILENT_TIMES = 3
_TIDS = 0x10000
_ADDRESSES = range(1, 248)


@dataclass(slots=True)
class _Request:
    """A request under way."""

    tid: int
    number: int  # ascending in the order of sending
    unit: int
    pdu: bytes
    sent_at: float
    timeout_s: float
    company: bool  # others were under way at some time during its wait


class TcpClient:
    """The state machine of one upstream; satisfies `Wire`.

    The shell's moves beyond those of `Wire`: `connected` when there is a connection, `lost` when it ended for whatever
    reason, and to end it when `drop` is not None: `FINISHED`, or what is wrong with it.
    """

    relays = True
    echo = Echo.ABSENT

    def __init__(
        self, counters: RtuCounters, upstream: UpstreamCounters, *, most: int, first_tid: Callable[[], int]
    ) -> None:
        self._counters = counters
        self._upstream = upstream
        self._window = Window(most)
        self._first_tid = first_tid
        self._tid = first_tid()
        self._number = 0
        self._under_way: dict[int, _Request] = {}
        self._retired: set[int] = set()
        self._splitter: MbapSplitter | None = None  # None: unconnected
        self._replies = 0  # on this connection
        self._newest_answered = 0
        self._suspect = False  # a request in company got no answer, and none has been asked alone since
        self._one_reply = 0  # connections in a row that the other end closed after one reply
        self._look_again_at = -math.inf
        self._finish_at: float | None = None  # when we end a connection that the other end should have ended
        self._silent = 0  # connections in a row that a time-out ended and nothing was heard on
        self._unheard: set[int] = set()  # the units that were asked on them and timed out
        self.drop: str | None = None

    @property
    def silent(self) -> bool:
        """Whether the server says nothing to anybody (rule 5)."""
        return self._silent >= SILENT_TIMES and len(self._unheard) > 1

    @property
    def window(self) -> int:
        """How many requests may be under way at once, as learnt."""
        return self._window.size

    def connected(self, now: float) -> None:
        """There is a connection, and nothing was sent on it."""
        del now
        self._splitter = MbapSplitter()
        self._replies = 0
        self._retired.clear()
        self._finish_at = None
        self._window.connected()
        self._tid = self._first_tid()
        self.drop = None
        self._upstream.connections += 1

    def lost(self, now: float, *, remote: bool) -> tuple[Ended, ...]:
        """The connection is over; `remote`: the other end closed or reset it. What was under way (rule 4)."""
        if self._splitter is None:
            return ()
        if self._splitter.pending:
            self._counters.noise_bytes += self._splitter.pending
        self._splitter = None
        if remote:
            if self._replies == 1:
                if self._one_reply >= ONE_REPLY_TIMES - 1:
                    self._look_again_at = now + LOOK_AGAIN_S
                self._one_reply += 1
            elif self._replies > 1:
                self._one_reply = 0
            self._upstream.lost["finished" if self._replies and not self._under_way else "closed"] += 1
        elif self.drop is not None:
            self._upstream.lost[self.drop or "finished"] += 1
        if len(self._under_way) > 1 and (remote or self.drop not in {None, "timeout"}):
            self._window.trouble(now)
        if self.drop == "timeout" and not self._replies:
            self._silent += 1
        ended = tuple(self._end(request, ConnectionLost("the connection was lost"), now) for request in self._waiting())
        self._under_way.clear()
        self._finish_at = None
        self.drop = None
        return ended

    def reset(self, now: float) -> None:
        """See `Wire.reset`; what is known of the server stays known."""
        del now
        self._splitter = None
        self._under_way.clear()
        self._finish_at = None
        self.drop = None

    def ready_at(self, now: float) -> float:
        """See `Wire.ready_at`."""
        if self._splitter is None or self.drop is not None or self._finish_at is not None:
            return math.inf
        if not self._under_way:
            return now
        room = 1 if self._replies == 0 or self._single_use(now) else self._window.size
        return now if len(self._under_way) < room else math.inf

    def send(self, address: int, pdu: bytes, now: float, timeout_s: float) -> tuple[int, bytes]:
        """See `Wire.send`.

        Raises ValueError for an address out of 1..247, IllegalFunction, IllegalDataValue or IllegalDataAddress for a
        PDU we do not speak, RuntimeError when `ready_at` says no. None of them changes anything.
        """
        if address not in _ADDRESSES:
            raise ValueError(f"address {address} is not in 1..247")
        expected_reply_size(pdu)
        if self.ready_at(now) > now:
            raise RuntimeError("there is no room: wait until ready_at")
        tid = self._next_tid()
        self._number += 1
        company = bool(self._under_way)
        for other in self._under_way.values():
            other.company = True
        self._under_way[tid] = _Request(tid, self._number, address, pdu, now, timeout_s, company)
        self._upstream.window = self._window.size
        return tid, encode(tid, address, pdu)

    def receive(self, data: bytes, now: float) -> list[Ended]:
        """See `Wire.receive`."""
        if self._splitter is None or self.drop is not None:
            self._counters.late_bytes += len(data)
            return []
        ended: list[Ended] = []
        adus = self._splitter.feed(data)
        self._check_stream(self._splitter, adus)
        for adu in adus:
            one = self._take(adu, now)
            if one is not None:
                ended.append(one)
        if self._replies and not self._under_way and self._single_use(now):
            self._finish_at = now + CLOSES_WITHIN_S
        return ended

    def on_timer(self, now: float) -> list[Ended]:
        """See `Wire.on_timer`."""
        if self._finish_at is not None and now >= self._finish_at and self.drop is None:
            self.drop = FINISHED
        late = [request for request in self._waiting() if now >= request.sent_at + request.timeout_s]
        ended = []
        for request in late:
            error = ReplyTimeout(f"no reply of unit {request.unit} within {request.timeout_s:g} s")
            del self._under_way[request.tid]
            self._suspect = request.company
            self._unheard.add(request.unit)
            if request.number < self._newest_answered and len(self._retired) < MOST_RETIRED:
                self._retired.add(request.tid)
            elif self.drop is None:
                self.drop = "timeout"
            ended.append(Ended(request.tid, Failed(error, request.sent_at, now, blameless=request.company)))
        return ended

    def next_deadline(self) -> float | None:
        """See `Wire.next_deadline`."""
        if self._finish_at is not None and self.drop is None:
            return self._finish_at
        return min((request.sent_at + request.timeout_s for request in self._under_way.values()), default=None)

    def bytes_due(self) -> int:
        """See `Wire.bytes_due`."""
        return 0

    def quarantine_s(self, now: float) -> float:
        """See `Wire.quarantine_s`; a connection needs none."""
        del now
        return 0.0

    def _waiting(self) -> list[_Request]:
        return list(self._under_way.values())

    def _take(self, adu: Adu, now: float) -> Ended | None:
        """Rules 1 and 2 for one ADU."""
        request = self._under_way.get(adu.tid)
        if self.drop is not None:
            self._counters.late_bytes += len(adu.pdu) + 7
            return None
        if request is None:
            if adu.tid in self._retired:
                self._retired.discard(adu.tid)
                self._upstream.late_replies += 1
                self._counters.late_bytes += len(adu.pdu) + 7
            else:
                self.drop = "transaction_id"
            return None
        error: RequestError | None = None
        if adu.unit != request.unit:
            self._counters.wrong_unit += 1
            self.drop = "unit_id"
            error = ReplyMismatch(f"unit {adu.unit} answered for unit {request.unit}")
        elif not reply_fits(request.pdu, adu.pdu):
            self._counters.mismatch += 1
            self.drop = "mismatch"
            error = ReplyMismatch(f"unit {request.unit} answered something else than it was asked")
        del self._under_way[adu.tid]
        if error is not None:
            if request.company or len(self._under_way):
                self._window.trouble(now)
            return self._end(request, error, now)
        self._replies += 1
        self._silent = 0
        self._unheard.clear()
        if self._replies > 1:
            self._one_reply = 0
        self._newest_answered = max(self._newest_answered, request.number)
        if self._suspect and not request.company:
            self._suspect = False
            self._window.trouble(now)
        else:
            self._window.answered(now)
        return Ended(adu.tid, Replied(adu.pdu, request.sent_at, now))

    def _end(self, request: _Request, error: RequestError, now: float) -> Ended:
        lost = isinstance(error, ConnectionLost) and (request.company or self._replies > 0)
        return Ended(request.tid, Failed(error, request.sent_at, now, blameless=lost))

    def _check_stream(self, splitter: MbapSplitter, adus: Sequence[Adu]) -> None:
        """Rule 1 for what is no whole ADU."""
        if splitter.foreign:
            self.drop = "protocol_id"
        elif splitter.lost is not None:
            self.drop = "length"
        elif splitter.pending:
            answered = {adu.tid for adu in adus}
            awaited = (self._under_way.keys() | self._retired) - answered
            if not any(splitter.begins(tid) for tid in awaited):
                self.drop = "unsolicited"

    def _single_use(self, now: float) -> bool:
        return self._one_reply >= ONE_REPLY_TIMES and now < self._look_again_at

    def _next_tid(self) -> int:
        while True:
            self._tid = (self._tid + 1) % _TIDS
            if self._tid not in self._under_way and self._tid not in self._retired:
                return self._tid
