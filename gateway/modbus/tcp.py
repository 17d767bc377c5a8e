"""The Modbus TCP client of one upstream: several requests under way, and no answer but their own.

Bytes and the time go in, the ends of requests come out; nothing here opens a connection or reads a clock. Times are
monotonic seconds. There are up to `connections` connections side by side, each a channel with a number from 0 on:

    UNCONNECTED ──connected──▶ CONNECTED ──lost──▶ UNCONNECTED
                                   └── `drop` is not None: the shell ends the connection and calls `lost`

Rule 1, the reply: it comes on its request's connection and has the transaction id, unit id and function (or its
    exception) of its request, and the exact shape (pdu.py). Anything else, another protocol id, a length that no ADU
    has, or bytes that cannot begin a reply to anybody mean that the stream cannot be trusted: the connection is
    dropped, and nothing more is taken from it, nor what came with those bytes: a reply that lost its end is made whole
    by the head of the next.
Rule 2, transaction ids: none is used twice on a connection while a reply to it may still come, nor by two that are
    under way. Those of requests that were given up are retired for as long as the connection lives; a late reply to
    one is counted and thrown away.
Rule 3, the time-out counts from the request to its whole reply. When a request that went out later on its connection
    was answered meanwhile, only the one is given up. Otherwise nothing tells a slow server from a dead connection: it
    is dropped.
Rule 4: what was under way on a connection that is lost ends with ConnectionLost. It is blameless when others were
    under way too, or when the connection had answered before: then it was the connection, not the request. So is a
    time-out in company. A request that is alone has nobody to blame but itself.
Rule 5, company: how many may be under way at once is learnt (pipelining.py), for all connections together. The first
    request of a connection is always alone on it. A request goes to the connection that has least to do.
Rule 6, what the server does with its connections is learnt (habits.py): whether one is good for one request only, and
    whether it answers anybody.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from gateway.errors import ConnectionLost, ReplyMismatch, ReplyTimeout, RequestError
from gateway.modbus.collector import Echo
from gateway.modbus.counters import RtuCounters, UpstreamCounters
from gateway.modbus.habits import CLOSES_WITHIN_S, Habits
from gateway.modbus.mbap import Adu, MbapSplitter, encode
from gateway.modbus.pdu import expected_reply_size, reply_fits
from gateway.modbus.pipelining import Window
from gateway.modbus.transactions import Ended, Failed, Replied

FINISHED = ""
"""`drop` when the connection is to be ended although nothing is wrong with it."""
MOST_RETIRED = 1024
_TIDS = 0x10000
_ADDRESSES = range(1, 248)


class _Channel:
    """One connection, as far as it matters here."""

    __slots__ = (
        "asked_at",
        "drop",
        "finish_at",
        "held_until",
        "newest_answered",
        "number",
        "replies",
        "retired",
        "splitter",
        "waiting",
    )

    def __init__(self, number: int) -> None:
        self.number = number
        self.splitter = MbapSplitter()
        self.retired: set[int] = set()
        self.waiting = 0  # requests under way on it
        self.replies = 0
        self.newest_answered = 0
        self.asked_at = math.inf  # when the first request went out
        self.held_until = -math.inf  # nothing goes out before
        self.finish_at: float | None = None  # when we end a connection that the other end should have ended
        self.drop: str | None = None


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
    channel: _Channel
    reply_size: int | None  # of its PDU; None: its content decides


class TcpClient:
    """The state machine of one upstream; satisfies `Wire`.

    The shell's moves beyond those of `Wire`: `connected` when there is a connection, `lost` when it ended for whatever
    reason, and to end it when `drop` of it is not None: `FINISHED`, or what is wrong with it.
    """

    relays = True
    echo = Echo.ABSENT

    def __init__(
        self,
        counters: RtuCounters,
        upstream: UpstreamCounters,
        *,
        most: int,
        first_tid: Callable[[], int],
        connections: int = 1,
    ) -> None:
        self._counters = counters
        self._upstream = upstream
        self._most = most
        self._window = Window(most * connections)
        self._habits = Habits()
        self._connections = connections
        self._channels: dict[int, _Channel] = {}
        self._first_tid = first_tid
        self._tid = first_tid()
        self._number = 0
        self._under_way: dict[int, _Request] = {}
        self._suspect = False  # a request in company got no answer, and none has been asked alone since
        self.sent_on = 0
        """The number of the connection that the last request is for."""

    @property
    def silent(self) -> bool:
        """Whether the server says nothing to anybody."""
        return self._habits.silent

    @property
    def window(self) -> int:
        """How many requests may be under way at once, as learnt."""
        return self._window.size

    @property
    def drop(self) -> str | None:
        """Why a connection must be ended, the first of them; None: all may stay."""
        return next((channel.drop for channel in self._channels.values() if channel.drop is not None), None)

    def drops(self) -> list[tuple[int, str]]:
        """The connections that must be ended, and why."""
        return [(channel.number, channel.drop) for channel in self._channels.values() if channel.drop is not None]

    def single_use(self, now: float) -> bool:
        """Whether a connection is good for one request."""
        return self._habits.single_use(now)

    def lacks(self, now: float) -> bool:
        """Whether a request that is to go out now would have to wait for nothing but one more connection."""
        if len(self._channels) >= self._connections or len(self._under_way) >= self._window.size:
            return False
        known = self._habits.keeps or self._habits.single_use(now)
        return not self._channels or (known and self._free(now) is None)

    def connected(self, now: float, channel: int = 0) -> None:
        """There is a connection of that number, and nothing was sent on it."""
        self._channels[channel] = _Channel(channel)
        if not self._habits.single_use(now):
            self._window.connected()
        self._tid = self._first_tid()
        self._upstream.connections += 1

    def lost(self, now: float, *, remote: bool, channel: int = 0) -> tuple[Ended, ...]:
        """A connection is over; `remote`: the other end closed or reset it. What was under way on it (rule 4)."""
        lost = self._channels.pop(channel, None)
        if lost is None:
            return ()
        self._counters.noise_bytes += lost.splitter.pending
        if remote:
            self._habits.closed(lost.replies, now)
            self._upstream.lost["finished" if lost.replies and not lost.waiting else "closed"] += 1
        elif lost.drop is not None:
            self._upstream.lost[lost.drop or "finished"] += 1
        if lost.drop == "timeout" and not lost.replies:
            self._habits.heard_nothing(lost.asked_at, now)
        if not lost.waiting:
            return ()
        own = [request for request in self._under_way.values() if request.channel is lost]
        crowded = len(own) > 1 or (not lost.replies and len(self._under_way) > len(own))
        if crowded and (remote or lost.drop not in {None, "timeout"}):
            self._window.trouble(now)
        ended = tuple(self._end(request, ConnectionLost("the connection was lost"), now) for request in own)
        for request in own:
            del self._under_way[request.tid]
        return ended

    def reset(self, now: float) -> None:
        """See `Wire.reset`; what is known of the server stays known."""
        del now
        self._channels.clear()
        self._under_way.clear()

    def ready_at(self, now: float) -> float:
        """See `Wire.ready_at`."""
        under_way = len(self._under_way)
        if under_way and under_way >= self._window.size:
            return math.inf
        if self._free(now) is not None:
            return now
        channels = self._channels.values()
        held = [c.held_until for c in channels if c.held_until > now and c.drop is None and c.finish_at is None]
        return min(held, default=math.inf)

    def send(self, address: int, pdu: bytes, now: float, timeout_s: float) -> tuple[int, bytes]:
        """See `Wire.send`; `sent_on` tells for which connection it is.

        Raises ValueError for an address out of 1..247, IllegalFunction, IllegalDataValue or IllegalDataAddress for a
        PDU we do not speak, RuntimeError when `ready_at` says no. None of them changes anything.
        """
        if address not in _ADDRESSES:
            raise ValueError(f"address {address} is not in 1..247")
        reply_size = expected_reply_size(pdu)
        under_way = self._under_way
        channel = self._free(now)
        if channel is None or (under_way and len(under_way) >= self._window.size):
            raise RuntimeError("there is no room: wait until ready_at")
        tid = self._next_tid()
        self._number += 1
        company = bool(under_way)
        if len(under_way) == 1:
            for other in under_way.values():  # who has company already is said to
                other.company = True
        under_way[tid] = _Request(tid, self._number, address, pdu, now, timeout_s, company, channel, reply_size)
        channel.waiting += 1
        channel.asked_at = min(channel.asked_at, now)
        self._upstream.window = self._window.size
        self.sent_on = channel.number
        return tid, encode(tid, address, pdu)

    def receive(self, data: bytes, now: float, channel: int = 0) -> list[Ended]:
        """See `Wire.receive`; `channel`: on which connection."""
        source = self._channels.get(channel)
        if source is None or source.drop is not None:
            self._counters.late_bytes += len(data)
            return []
        ended: list[Ended] = []
        splitter = source.splitter
        adus = splitter.feed(data)
        if splitter.foreign or splitter.lost is not None or splitter.pending:
            self._check_stream(source, adus)
        if source.waiting > 1 or source.retired:
            self._check_whole(source, adus)
        for adu in adus:
            one = self._take(source, adu, now)
            if one is not None:
                ended.append(one)
        if source.replies and not source.waiting and self._habits.single_use(now):
            source.finish_at = now + CLOSES_WITHIN_S
        return ended

    def on_timer(self, now: float) -> list[Ended]:
        """See `Wire.on_timer`."""
        for channel in self._channels.values():
            if channel.finish_at is not None and now >= channel.finish_at and channel.drop is None:
                channel.drop = FINISHED
        late = [request for request in self._under_way.values() if now >= request.sent_at + request.timeout_s]
        ended = []
        for request in late:
            error = ReplyTimeout(f"no reply of unit {request.unit} within {request.timeout_s:g} s")
            channel = request.channel
            del self._under_way[request.tid]
            channel.waiting -= 1
            self._suspect = request.company
            self._habits.unanswered(request.unit)
            if request.number < channel.newest_answered and len(channel.retired) < MOST_RETIRED:
                channel.retired.add(request.tid)
            elif channel.drop is None:
                channel.drop = "timeout"
            ended.append(Ended(request.tid, Failed(error, request.sent_at, now, blameless=request.company)))
        return ended

    def next_deadline(self) -> float | None:
        """See `Wire.next_deadline`."""
        moments = [c.finish_at for c in self._channels.values() if c.finish_at is not None and c.drop is None]
        moments += [request.sent_at + request.timeout_s for request in self._under_way.values()]
        return min(moments, default=None)

    def bytes_due(self) -> int:
        """See `Wire.bytes_due`."""
        return 0

    def quarantine_s(self, now: float) -> float:
        """See `Wire.quarantine_s`; a connection needs none."""
        del now
        return 0.0

    def _free(self, now: float) -> _Channel | None:
        """The connection that may take a request now and has least to do, or None (rule 5)."""
        best: _Channel | None = None
        for channel in self._channels.values():
            if channel.drop is not None or channel.finish_at is not None or channel.held_until > now:
                continue
            waiting = channel.waiting
            if waiting and (not channel.replies or waiting >= self._most or self._habits.single_use(now)):
                continue
            if best is None or waiting < best.waiting:
                best = channel
        return best

    def _take(self, channel: _Channel, adu: Adu, now: float) -> Ended | None:
        """Rules 1 and 2 for one ADU."""
        if channel.drop is not None:
            self._counters.late_bytes += len(adu.pdu) + 7
            return None
        request = self._under_way.get(adu.tid)
        if request is None or request.channel is not channel:
            if adu.tid in channel.retired:
                channel.retired.discard(adu.tid)
                self._upstream.late_replies += 1
                self._counters.late_bytes += len(adu.pdu) + 7
            else:
                channel.drop = "transaction_id"
            return None
        error: RequestError | None = None
        if adu.unit != request.unit:
            self._counters.wrong_unit += 1
            channel.drop = "unit_id"
            error = ReplyMismatch(f"unit {adu.unit} answered for unit {request.unit}")
        elif not reply_fits(request.pdu, adu.pdu):
            self._counters.mismatch += 1
            channel.drop = "mismatch"
            error = ReplyMismatch(f"unit {request.unit} answered something else than it was asked")
        del self._under_way[adu.tid]
        channel.waiting -= 1
        if error is not None:
            if request.company or len(self._under_way):
                self._window.trouble(now)
            return self._end(request, error, now)
        channel.replies += 1
        self._habits.answered(channel.replies)
        if channel.replies == 1 and not self._habits.keeps:
            channel.held_until = now + CLOSES_WITHIN_S
        channel.newest_answered = max(channel.newest_answered, request.number)
        if self._suspect and not request.company:
            self._suspect = False
            self._window.trouble(now)
        else:
            self._window.answered(now)
        return Ended(adu.tid, Replied(adu.pdu, request.sent_at, now))

    def _end(self, request: _Request, error: RequestError, now: float) -> Ended:
        lost = isinstance(error, ConnectionLost) and (request.company or request.channel.replies > 0)
        return Ended(request.tid, Failed(error, request.sent_at, now, blameless=lost))

    def _check_stream(self, channel: _Channel, adus: Sequence[Adu]) -> None:
        """Rule 1 for what is no whole ADU."""
        splitter = channel.splitter
        if splitter.foreign:
            channel.drop = "protocol_id"
        elif splitter.lost is not None:
            channel.drop = "length"
        elif splitter.pending:
            answered = {adu.tid for adu in adus}
            asked = {tid for tid, request in self._under_way.items() if request.channel is channel}
            if not any(splitter.begins(tid) for tid in (asked | channel.retired) - answered):
                channel.drop = "unsolicited"

    def _check_whole(self, channel: _Channel, adus: Sequence[Adu]) -> None:
        """Rule 1 for a reply that lost its end and was made whole by all of another, so that nothing is left over."""
        sizes = {2}  # of the replies that others wait for: exceptions, and
        others = set(channel.retired)  # those whose size nobody knows
        for tid, request in self._under_way.items():
            if request.channel is not channel:
                continue
            if request.reply_size is None:
                others.add(tid)
            else:
                sizes.add(request.reply_size)
        heads = [(7 + size, b"\0\0" + (size + 1).to_bytes(2)) for size in sizes]
        for adu in adus:
            for length, head in heads:
                at = len(adu.pdu) - length
                if at >= 0 and adu.pdu[at + 2 : at + 6] == head:
                    tid = int.from_bytes(adu.pdu[at : at + 2])
                    other = self._under_way.get(tid)
                    if other is not None and other.channel is channel and tid != adu.tid:
                        channel.drop = "length"
            for tid in others:
                if tid != adu.tid and _ends_with(adu.pdu, tid):
                    channel.drop = "length"

    def _next_tid(self) -> int:
        while True:
            self._tid = (self._tid + 1) % _TIDS
            if self._tid in self._under_way:
                continue
            for channel in self._channels.values():
                if self._tid in channel.retired:
                    break
            else:
                return self._tid


def _ends_with(pdu: bytes, tid: int) -> bool:
    """Whether the end of a PDU is a whole ADU with that transaction id."""
    at = pdu.rfind(tid.to_bytes(2) + b"\0\0\0")  # the protocol id, and the length's first byte
    return 0 <= at < len(pdu) - 5 and at + 6 + pdu[at + 5] == len(pdu)
