"""One Modbus TCP client.

Rule 1: replies leave in the order of their requests. A request that waits for the line holds back
        what came after it on this connection, and nothing on any other.
Rule 2: nothing grows without bound. While `MAX_WAITING` replies are due, or the client has not taken the last ones, no
        further request is looked at and nothing is read. At most `MAX_UNSENT` bytes wait to be taken: one burst, or
        the replies that were due; those that come to be known in the meantime are still due.
Rule 3: every request is answered, or its connection ends, within `reply_timeout_s` of its arrival: framing lost or
        end of stream lets what came before be answered first; a client that is gone has its questions withdrawn
        and gets nothing; a server that stops answers 06 to what it has not begun.
Rule 4: a client that asks more than it may is not read from for a while (core/ratelimit.py).
Rule 5: no exception leaves this file. What was not foreseen is logged, counted, and ends the connection.

The way in has two lanes. A whole request that `HotReplies` knows is answered in `data_received` with one
lookup, paid with one of the client's tokens; everything else goes through the splitter and the dispatcher.
"""

from __future__ import annotations

import asyncio
import logging
import math
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import cast

from gateway.core.clients import Client
from gateway.core.ratelimit import ClientRate
from gateway.core.site import Outcome, Ticket
from gateway.errors import ShuttingDown
from gateway.faces.modbus.dispatch import Dispatcher, Waiting
from gateway.faces.modbus.settings import ModbusSettings
from gateway.faces.modbus.tcp import client_name, keep_alive
from gateway.modbus.mbap import Adu, MbapSplitter

logger = logging.getLogger(__name__)

MAX_WAITING = 16
MAX_UNSENT = 8192
LONGEST_REPLY = 260
MAX_HELD_BACK = 2048  # what a transport may collect (tls_session.py) before it sends
MAX_BURST = (MAX_UNSENT - MAX_HELD_BACK) // LONGEST_REPLY  # replies joined into one write
READ_SIZE = 12  # a read request on the wire: MBAP 7, function, address, quantity
READ_HEAD = b"\0\0\0\6"  # its protocol id and length
PIECE = 2048  # how much of a long segment is cut into requests at a time
TURN = 256  # requests looked at before other connections have their turn
AT_ONCE_S = 0.1
NOBODY = Client("", ClientRate(), 0.0, 0.0)


class _Due:
    """A reply that has its place in the order and may not be there yet."""

    __slots__ = ("reply", "since", "ticket", "tid", "waiting")

    def __init__(self, tid: bytes, since: float) -> None:
        self.tid = tid
        self.since = since
        self.reply: bytes | None = None
        self.waiting: Waiting | None = None
        self.ticket: Ticket | None = None


class Connection(asyncio.Protocol):
    """The protocol of one connection; `left` is called once when it is over."""

    def __init__(
        self,
        dispatcher: Dispatcher,
        settings: ModbusSettings,
        admit: Callable[[Connection, str], Client | None],
        left: Callable[[Connection], None],
    ) -> None:
        self._dispatcher = dispatcher
        self._settings = settings
        self._admit = admit
        self._left = left
        self._stats = dispatcher.stats
        self._find = dispatcher.hot.find
        self._now = dispatcher.now
        self._transport: asyncio.Transport | None = None
        self._write: Callable[[bytes], None] = _nowhere
        self._splitter = MbapSplitter()
        self._foreign = 0  # ADUs with another protocol id, as far as they are counted
        self._suspect = False  # the last ADUs had one: the splitter must see what comes next
        self._input = b""  # received, not yet cut
        self._adus: deque[Adu] = deque()  # cut, not yet answered
        self._due: deque[_Due] = deque()
        self._direct = False  # nothing is under way: a hot reply may be written at once
        self._reading = True
        self._ending = False  # no further request is taken; closes when all replies are out
        self._over = False  # closed, or about to be
        self._closing_since: float | None = None
        self._resume: asyncio.Handle | None = None  # nothing is looked at before it has run
        self._held_since: float | None = None  # something received waits to be looked at
        self._unread_since = 0.0  # reading was paused then, and resumed at:
        self._resumed_at = -math.inf
        self._unsent_since: float | None = None
        self._partial_since: float | None = None
        self.peer = ""  # the client's address, by which it is counted and has its share of a line
        self.client = NOBODY
        self.role: str | None = None  # that of the client's certificate
        self.seen = 0.0  # monotonic time of the last request

    # What asyncio calls

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Let the client in, or end the connection before a byte is read."""
        self._transport = cast("asyncio.Transport", transport)
        self.seen = self._now()
        self.peer = client_name(transport.get_extra_info("peername"))
        client = self._admit(self, self.peer)
        if client is None:
            self._over = True
            self._transport.abort()
            return
        self.client = client
        keep_alive(transport)
        self._transport.set_write_buffer_limits(high=0)  # whatever the kernel does not take pauses us (rule 2)
        self._write = self._transport.write
        self._direct = True

    def data_received(self, data: bytes) -> None:
        """Answer what can be answered now, in order."""
        try:
            if self._direct:
                entry = self._find(data[2:])
                if entry is not None:
                    valid_until, device, mark, reply = entry
                    now = self._now()
                    client = self.client
                    left = client.left
                    if left and now < valid_until and device.snapshot.mark is mark:
                        client.left = left - 1
                        self.seen = now
                        self._write(data[:2] + reply)
                        return
                elif len(data) > READ_SIZE:
                    data = self._answer_hot(data)
                if len(data) == READ_SIZE and data[2:6] == READ_HEAD:
                    self._take_one(Adu(int.from_bytes(data[:2]), data[6], data[7:]))
                    return
            if data and not self._ending:
                self._input += data
                self._work()
        except Exception:
            logger.exception("event=connection_failed peer=%s", self.peer)
            self._broken()

    def eof_received(self) -> bool:
        """The client sends no more; what it asked is still answered."""
        self._ending = True
        self._direct = False
        self._guarded(self._work)
        return not self._over

    def pause_writing(self) -> None:
        """The client does not take its replies."""
        self._unsent_since = self._now()
        self._direct = False
        self._set_reading(on=False)

    def resume_writing(self) -> None:
        """The client took its replies."""
        self._unsent_since = None
        self._guarded(self._send_due)
        self._guarded(self._work)

    def connection_lost(self, exc: Exception | None) -> None:
        """Withdraw what this client asked of the lines; how it went (`exc`) makes no difference."""
        del exc
        self._over = True
        self._direct = False
        if self._resume is not None:
            self._resume.cancel()
        for due in self._due:
            if due.ticket is not None:
                due.ticket.cancel(None if due.waiting is None else due.waiting.concluded)
        self._due.clear()
        self._adus.clear()
        self._input = b""
        self._write = _nowhere
        self._left(self)

    # What the server calls

    def identified(self, role: str | None, dispatcher: Dispatcher | None = None) -> None:
        """Serve the client by this role, and in another way than was foreseen; called before its first request."""
        self.role = role
        if dispatcher is not None:
            self._dispatcher = dispatcher
            self._find = dispatcher.hot.find

    def adjust(self, settings: ModbusSettings) -> None:
        """Go on by other settings."""
        self._settings = settings

    @property
    def idle(self) -> bool:
        """Whether the client waits for nothing."""
        return not self._due and self._unsent_since is None

    def overdue(self, now: float) -> str | None:
        """Why this connection should end at `now`; None: it is fine."""
        settings = self._settings
        if self._closing_since is not None:
            return "not_reading" if now - self._closing_since > settings.write_timeout_s else None
        since = self._due[0].since if self._due else self._held_since
        if self._held_since is not None and since is not None:
            since = min(since, self._held_since)
        if since is not None and now - since > settings.reply_timeout_s:
            return "unanswered"
        if self._unsent_since is not None and now - self._unsent_since > settings.write_timeout_s:
            return "not_reading"
        if self._reading and self._partial_since is not None and now - self._partial_since > settings.frame_timeout_s:
            return "slow_frame"
        if self.idle and now - self.seen > settings.idle_timeout_s:
            return "idle"
        return None

    def end(self, reason: str) -> None:
        """End the connection now, whatever is under way; counted under `reason`."""
        if self._transport is None:
            return
        self._stats.closed[reason] += 1
        self._direct = False
        if self.idle and not self._over:
            self._closing_since = self._now()
            self._transport.close()
        else:
            self._transport.abort()
        self._over = True

    def finish(self) -> None:
        """Take no further request, answer 06 to those not begun, and close when all are answered."""
        self._ending = True
        self._direct = False
        if self._resume is not None:
            self._resume.cancel()
            self._resume = None
        self._guarded(self._refuse_the_rest)

    def give_up(self) -> None:
        """Wait no longer for what is under way: answer 06 to it (to a write that has begun 0B), and close."""
        for due in self._due:
            if due.waiting is not None and due.reply is None:
                unit, pdu = due.waiting.unit, due.waiting.pdu
                due.reply = self._dispatcher.refuse(unit, pdu, self.client, due.waiting.given_up(due.ticket))
            if due.ticket is not None:
                due.ticket.cancel()
                due.ticket = None
        self._guarded(self._send_due)
        self._guarded(self._settle)

    def _refuse_the_rest(self) -> None:
        now = self._now()
        while not self._over and (self._adus or self._cut(now)):
            adu = self._adus.popleft()
            due = _Due(adu.tid.to_bytes(2), now)
            due.reply = self._dispatcher.refuse(adu.unit, adu.pdu, self.client, ShuttingDown())
            self._stats.requests += 1
            self.client.unpaid += 1
            self._due.append(due)
        self._send_due()
        self._settle()

    # The way in

    def _answer_hot(self, data: bytes) -> bytes:
        """Answer requests from the front of a segment as long as each is known; returns the rest."""
        find = self._find
        client = self.client
        now = self._now()
        size = len(data)
        at = 0
        while self._direct and client.lease(now):
            out: list[bytes] = []
            hits = 0
            most = min(MAX_BURST, client.left)
            while hits < most and at + READ_SIZE <= size:
                entry = find(data[at + 2 : at + READ_SIZE])
                if entry is None or now >= entry[0] or entry[1].snapshot.mark is not entry[2]:
                    break
                out.append(data[at : at + 2])
                out.append(entry[3])
                hits += 1
                at += READ_SIZE
            if not hits:
                break
            self.seen = now
            client.left -= hits
            self._write(b"".join(out))  # may call pause_writing, which ends the loop
        return data[at:] if at else data

    def _take_one(self, adu: Adu) -> None:
        """Look at a request that is all that there is: nothing came before it that is not answered."""
        self.seen = now = self._now()
        out: list[bytes] = []
        self._take(adu, now, out)
        if out:
            self._write(b"".join(out))  # may call pause_writing
        if self.client.pause_s:
            self._pause()
            self._settle()
        elif self._due:
            self._direct = False

    def _pause(self) -> None:
        """Rule 4."""
        pause_s, self.client.pause_s = self.client.pause_s, 0.0
        self._resume = asyncio.get_running_loop().call_later(pause_s, self._work_on)

    def _work(self) -> None:
        """Look at what was received as far as rules 1 and 2 allow."""
        if self._over or self._resume is not None:
            return
        now = self._now()
        out: list[bytes] = []
        looked_at = 0
        while len(self._due) < MAX_WAITING and self._unsent_since is None and (self._adus or self._cut(now)):
            if looked_at == TURN:
                self._resume = asyncio.get_running_loop().call_soon(self._work_on)
                break
            looked_at += 1
            self.seen = now
            self._take(self._adus.popleft(), now, out)
            if self.client.pause_s:
                self._pause()
                break
            if len(out) >= 2 * MAX_BURST:  # a transaction id and the rest, each
                self._write(b"".join(out))
                out.clear()
        if out:
            self._write(b"".join(out))
        self._settle()

    def _work_on(self) -> None:
        """Go on after the others had their turn, or a pause is over."""
        self._resume = None
        self._guarded(self._work)

    def _cut(self, now: float) -> bool:
        """Cut the next piece of the input; whether there is a request now."""
        splitter = self._splitter
        while self._input:
            piece, self._input = self._input[:PIECE], self._input[PIECE:]
            self._adus.extend(splitter.feed(piece))
            foreign = splitter.foreign - self._foreign
            if foreign:
                self._foreign = splitter.foreign
                self._stats.malformed["protocol_id"] += foreign
                self._suspect = True
            elif self._adus:
                self._suspect = False
            if not splitter.pending:
                self._partial_since = None
            elif self._adus or self._partial_since is None:
                self._partial_since = now
            if splitter.lost is not None:
                self._stats.malformed[f"framing_{splitter.lost}"] += 1
                self._stats.closed["framing_lost"] += 1
                self._input = b""
                self._ending = True
            if self._adus:
                return True
        return False

    def _take(self, adu: Adu, now: float, out: list[bytes]) -> None:
        """Answer one request, or ask for its answer; what may leave now is put into `out`."""
        tid = adu.tid.to_bytes(2)
        answer = self._dispatcher.answer(adu.unit, adu.pdu, self.client, now, self.role)
        if isinstance(answer, bytes) and not self._due:
            out.append(tid)
            out.append(answer)
            return
        due = _Due(tid, now)
        self._due.append(due)
        if isinstance(answer, bytes):
            due.reply = answer
            return
        due.waiting = answer
        due.ticket = answer.begin(self.peer, partial(self._done, due))

    # The way out

    def _done(self, due: _Due, outcome: Outcome) -> None:
        """The line has answered a request of this connection."""
        try:
            self._conclude(due, outcome)
        except Exception:
            logger.exception("event=connection_failed peer=%s", self.peer)
            self._broken()

    def _conclude(self, due: _Due, outcome: Outcome) -> None:
        if self._over:
            return
        assert due.waiting is not None
        due.ticket = None
        due.reply = self._dispatcher.conclude(due.waiting, self.client, outcome)
        if due is not self._due[0]:
            return
        if len(self._due) == 1 and self._reading and not (self._adus or self._input or self._ending or self._suspect):
            self._due.clear()
            self._write(due.tid + due.reply)  # may call pause_writing
            self._direct = self._unsent_since is None and self._resume is None and not self._splitter.pending
            return
        self._send_due()
        self._work()

    def _send_due(self) -> None:
        """Send the replies whose turn it is (rule 1), if the client takes any (rule 2)."""
        if self._unsent_since is not None:
            return
        out: list[bytes] = []
        while self._due and (reply := self._due[0].reply) is not None:
            out.append(self._due.popleft().tid)
            out.append(reply)
        if out:
            self._write(b"".join(out))

    def _settle(self) -> None:
        """After any change: read on or pause, close when all is said."""
        if self._over:
            return
        assert self._transport is not None
        waiting = bool(self._adus or self._input)
        if self._ending:
            self._set_reading(on=False)
            if not self._due and not waiting:
                self._over = True
                self._closing_since = self._now()
                self._transport.close()
            return
        blocked = waiting or self._unsent_since is not None or self._resume is not None
        self._hold(waiting=waiting)
        self._set_reading(on=not blocked)
        self._direct = not (self._due or blocked or self._splitter.pending or self._suspect)

    def _hold(self, *, waiting: bool) -> None:
        """Know since when something waits to be looked at (rule 3).

        What comes as soon as reading is resumed may have waited in the kernel since it was paused, and what comes
        after that for as long. So a client that always has more under way than we take must have a pause some time.
        """
        if not waiting:
            self._held_since = None
        elif self._held_since is None:
            now = self._now()
            self._held_since = self._unread_since if now - self._resumed_at < AT_ONCE_S else now

    def _set_reading(self, *, on: bool) -> None:
        if self._transport is None or on is self._reading or self._transport.is_closing():
            return
        self._reading = on
        now = self._now()
        if on:
            self._resumed_at = now
            if self._partial_since is not None:
                self._partial_since = now  # it was our turn until now
            self._transport.resume_reading()
        else:
            self._unread_since = now if self._held_since is None else self._held_since
            self._transport.pause_reading()

    def _guarded(self, step: Callable[[], None]) -> None:
        """Rule 5."""
        try:
            step()
        except Exception:
            logger.exception("event=connection_failed peer=%s", self.peer)
            self._broken()

    def _broken(self) -> None:
        self._stats.closed["error"] += 1
        self._over = True
        self._direct = False
        if self._transport is not None:
            self._transport.abort()


def _nowhere(data: bytes) -> None:
    """Stand for the transport before there is one."""
    del data
