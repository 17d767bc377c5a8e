"""Sends the notifications: one task and one UDP socket a receiver.

Rule 1: receivers do not know of each other; one that is away, slow or hostile costs the others nothing.
Rule 2: between two datagrams the other tasks of the loop have their turn.
Rule 3: SNMPv3 needs the engine of the agent, its boots on disk before the first trap. Without an engine the receivers
        that need one are left out, and the log says so.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
from collections.abc import Callable, Sequence

from gateway.clock import Clock
from gateway.core.conditions import Conditions, Watch
from gateway.core.stats import NotifyStats
from gateway.faces.snmp.delivery import Delivery, Note
from gateway.faces.snmp.engine import Engine, EngineLost
from gateway.faces.snmp.layout import Layout
from gateway.faces.snmp.notify_pdu import PduWriter
from gateway.faces.snmp.notify_security import Channel, CommunityChannel, InformChannel, TrapChannel
from gateway.faces.snmp.reader import NotSnmp
from gateway.faces.snmp.responder import DATAGRAM_LIMIT
from gateway.faces.snmp.settings import Receiver
from gateway.faces.snmp.throttle import Throttle

OPEN_AGAIN_S = 5.0

_log = logging.getLogger(__name__)


class Notifier:
    """All receivers of one gateway; `engine` gives the agent's SNMPv3 engine, or raises EngineLost."""

    name = "notifications"

    def __init__(
        self,
        receivers: Sequence[Receiver],
        layout: Layout,
        *,
        site: str,
        clock: Clock,
        engine: Callable[[], Engine],
        ticks: Callable[[float], int],
        before: Notifier | None = None,
    ) -> None:
        """With `before`, which must have ended by the time that this one runs, its receivers are told what is left.

        A receiver that only has another secret, rate or the like is the same one: it is not told all anew.
        """
        self._clock = clock
        self._engine = engine
        now = clock.monotonic()
        known = {} if before is None else {post.receiver: post for post in before._posts}  # noqa: SLF001 - its own kind
        others = {post.place: post for receiver, post in known.items() if receiver not in receivers}
        self._posts: list[_Post] = []
        for receiver in receivers:
            if receiver in known:
                self._posts.append(known[receiver])
                continue
            same = others.pop((receiver.label, receiver.inform), None)
            if same is not None:
                same.adjust(receiver, now)
                self._posts.append(same)
                continue
            stats = NotifyStats(receiver.label, "inform" if receiver.inform else "trap")
            writer = PduWriter(layout, site, ticks, inform=receiver.inform)
            delivery = Delivery(receiver, writer, stats, now, cold=before is None)
            self._posts.append(_Post(receiver, delivery, clock))

    @property
    def stats(self) -> Sequence[NotifyStats]:
        """What was sent to each receiver, in the order of the configuration."""
        return tuple(post.delivery.stats for post in self._posts)

    def changed(self, watches: Sequence[Watch], now: float) -> None:
        """Conditions changed."""
        for post in self._posts:
            post.delivery.changed(watches, now)
            post.wake.set()

    def go_on(self, conditions: Conditions) -> None:
        """There are these conditions from now on."""
        for post in self._posts:
            post.delivery.go_on(conditions)

    def authentication_failed(self, _host: str) -> None:
        """A message with a wrong credential came."""
        now = self._clock.monotonic()
        for post in self._posts:
            post.delivery.authentication_failed(now)
            post.wake.set()

    async def run(self) -> None:
        """Send until cancelled."""
        async with asyncio.TaskGroup() as group:
            for post in self._posts:
                try:
                    channel = self._channel(post.receiver)
                except EngineLost as error:
                    _log.error('event=notify_off receiver=%s reason="%s"', post.receiver.label, error)
                    continue
                group.create_task(post.run(channel), name=f"notify {post.receiver.label}")
            await asyncio.Event().wait()

    def _channel(self, receiver: Receiver) -> Channel:
        if receiver.community is not None:
            return CommunityChannel(receiver.community)
        assert receiver.credentials is not None
        if receiver.inform:
            return InformChannel(receiver.credentials)
        return TrapChannel(receiver.credentials, self._engine())


class _Post:
    """One receiver: what it is told and the socket to it."""

    def __init__(self, receiver: Receiver, delivery: Delivery, clock: Clock) -> None:
        self.receiver = receiver
        self.delivery = delivery
        self.wake = asyncio.Event()
        self._clock = clock
        self._throttle = Throttle()
        self._was_silent = False

    @property
    def place(self) -> tuple[str, bool]:
        """Where it is, and whether it is told by informs."""
        return self.receiver.label, self.receiver.inform

    def adjust(self, receiver: Receiver, now: float) -> None:
        """Go on by other settings of the same place; `run` is given their channel."""
        self.receiver = receiver
        self.delivery.adjust(receiver, now)

    async def run(self, channel: Channel) -> None:
        """Send until cancelled."""
        while True:
            try:
                sock = self._open()
            except OSError as error:
                self._say("notify_failed", error.strerror or str(error))
                await asyncio.sleep(OPEN_AGAIN_S)
                continue
            loop = asyncio.get_running_loop()
            loop.add_reader(sock, self._readable, sock, channel)
            try:
                await self._work(sock, channel)
            finally:
                loop.remove_reader(sock)
                sock.close()

    async def _work(self, sock: socket.socket, channel: Channel) -> None:
        delivery = self.delivery
        while True:
            self.wake.clear()
            for note in delivery.outgoing(self._clock.monotonic()):
                self._send(sock, channel, note)
                await asyncio.sleep(0)  # rule 2
            self._watch()
            now = self._clock.monotonic()
            deadline = delivery.next_deadline(now)
            if deadline is not None and deadline <= now:
                continue
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(None if deadline is None else deadline - now):
                    await self.wake.wait()

    def _open(self) -> socket.socket:
        family = socket.AF_INET6 if ":" in self.receiver.host else socket.AF_INET
        sock = socket.socket(family, socket.SOCK_DGRAM)
        try:
            sock.setblocking(False)  # noqa: FBT003 - its only parameter, and positional-only
            sock.connect((self.receiver.host, self.receiver.port))
        except OSError:
            sock.close()
            raise
        return sock

    def _send(self, sock: socket.socket, channel: Channel, note: Note) -> None:
        now = self._clock.monotonic()
        data = channel.seal(note.request_id, note.pdu, now)
        try:
            try:
                sock.send(data)
            except ConnectionRefusedError:
                # It tells of an earlier datagram, and that it is known; this one was not sent.
                self._say("notify_failed", "connection refused")
                sock.send(data)
        except OSError as error:
            self.delivery.not_sent(note, now)
            self._say("notify_failed", error.strerror or str(error))
        else:
            self.delivery.sent(note, now)

    def _readable(self, sock: socket.socket, channel: Channel) -> None:
        now = self._clock.monotonic()
        try:
            data = sock.recv(DATAGRAM_LIMIT + 1)
        except (BlockingIOError, InterruptedError):
            return
        except OSError as error:
            self._say("notify_failed", error.strerror or str(error))
            return
        try:
            heard = channel.heard(data, now) if len(data) <= DATAGRAM_LIMIT else None
        except NotSnmp:
            self._say("notify_answer_dropped", "malformed")
            return
        if heard is None:
            return
        if heard.acknowledged:
            self.delivery.acknowledged(heard.request_id, now)
        elif heard.again:
            self.delivery.again(heard.request_id, now)
        else:
            self.delivery.stats.refused[heard.refused] += 1
            self._say("notify_refused", heard.refused)
        self.wake.set()

    def _watch(self) -> None:
        """Say when a receiver does not acknowledge any more, and when it does again."""
        silent = self.delivery.silent
        self.delivery.stats.silent = silent
        if silent is not self._was_silent:
            self._was_silent = silent
            event = "notify_silent" if silent else "notify_acknowledged_again"
            _log.log(logging.WARNING if silent else logging.INFO, "event=%s receiver=%s", event, self.receiver.label)

    def _say(self, event: str, reason: str) -> None:
        count = self._throttle.due(f"{event} {reason}", self._clock.monotonic())
        if count:
            _log.warning('event=%s receiver=%s reason="%s" count=%d', event, self.receiver.label, reason, count)
