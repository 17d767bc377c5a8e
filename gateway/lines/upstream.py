"""The asyncio shell of one Modbus TCP upstream.

It makes no decision about requests: it keeps connections, moves bytes and time between them and the `UpstreamEngine`,
and connects again when one ended.

Rule 1: nothing here blocks the loop: names are looked up in a thread, one lookup at a time.
Rule 2: when the last connection ends it is followed by the next at once, whatever ended it, so that a server that
        closes after every reply is ready for the next request one handshake later. Only one that the server closed
        within a second, before anything was asked on it, is followed after a pause.
Rule 3: the line is open until no connection could be had for `GRACE_S`: until then requests wait, and devices stay as
        they are. After that it is down, what waited has ended, and the pauses between tries grow from 0.1 to 4.5 s.
Rule 4: a server that answers no request of any controller (modbus/tcp.py) is down too, although it lets us connect.
        Whether the line is up is said when the first reply has come.
Rule 5: a name is looked up again whenever the line is down, and not while it is open.
Rule 6: a connection that is of no use any more is closed, not drained: none is ever half open. A peer that is gone
        without a word is noticed by the time-out of a request, or by keep-alive after a dozen seconds.
Rule 7: one log line when the line goes down or cannot be opened for another reason than before, one when it is up,
        and at most one a minute for each reason why a connection was dropped.
Rule 8: a further connection is made when a request waits for nothing else, one at a time, up to what is configured.
        One that cannot be had, or that the server closes unasked, is no reason to say anything: none is tried for
        `FEWER_S`, then for twice as long each time, and what there is goes on.
"""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import logging
import os
import socket
from collections.abc import Sequence
from functools import partial
from random import Random

from gateway.clock import Clock
from gateway.core.budget import GRACE_S
from gateway.core.settings import LineSettings
from gateway.core.site import Device
from gateway.core.upstream import UpstreamEngine
from gateway.errors import PortError
from gateway.lines.links import Address, Link, Links
from gateway.lines.shell import LONGEST_ALARM_S, STABLE_S, LineShell
from gateway.lines.threads import in_thread

log = logging.getLogger(__name__)

FIRST_RETRY_S = 0.1
LAST_RETRY_S = 4.5
GRACE_RETRY_S = 0.02
AT_ONCE_S = 1.0
"""A connection that the server closes sooner, without having been asked anything, is no connection."""
FEWER_S = 1.0
MOST_FEWER_S = 600.0
SAY_AGAIN_S = 60.0
EARLY_S = 0.0005
"""A timer that goes off so much too early is not set anew."""


class UpstreamLine(LineShell):
    """One upstream: satisfies `core.site.LinePort`."""

    def __init__(
        self, settings: LineSettings, devices: Sequence[Device], clock: Clock, rng: Random | None = None
    ) -> None:
        assert settings.upstream is not None, "a serial line has a SerialLine"
        self._rng = rng if rng is not None else Random()  # noqa: S311  # jitter, not secrets
        self._up = UpstreamEngine(settings, devices, clock.monotonic(), self._rng)
        super().__init__(self._up, devices, clock)
        self._where = settings.upstream
        self._loop: asyncio.AbstractEventLoop | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._deadline = 0.0  # what the timer is for, or sooner
        self._acted_at = 0.0
        self._links: Links | None = None
        self._used: dict[int, Link] = {}  # the connections by their numbers
        self._making: Link | None = None  # one that is not there yet
        self._making_ends: asyncio.TimerHandle | None = None
        self._reached: asyncio.Future[Link] | None = None  # `run` waits for the first
        self._gone: asyncio.Future[bool] | None = None  # `run` waits for the end of the last: whether it was of use
        self._no_more_before = 0.0  # rule 8
        self._fewer_s = FEWER_S
        self._lookup: asyncio.Future[list[Address]] | None = None
        self._addresses: list[Address] = []
        self._address: Address | None = None  # of the last connection that was made
        self._open = False
        self._opened_at = 0.0
        self._lost_at = 0.0  # when a connection that was of use ended
        self._unheard_of = True  # no reply since the line was opened
        self._announcing: asyncio.TimerHandle | None = None
        self._said_at: dict[str, float] = {}

    def overdue_s(self, now: float) -> float:
        """How long the engine has had something to do and was not let; 0 while there is no connection."""
        if not self._used or self._engine.next_deadline(now) is None:
            return 0.0
        return max(0.0, now - max(self._deadline, self._acted_at))

    async def run(self) -> None:
        """Own the upstream until cancelled."""
        self._loop = asyncio.get_running_loop()
        self._links = Links()
        retry_s = FIRST_RETRY_S
        try:
            while True:
                try:
                    link = await self._connect()
                except PortError as error:
                    self._up.upstream.refused += 1
                    if self._open and self._grace_s() > 0:
                        await asyncio.sleep(GRACE_RETRY_S)
                        continue
                    self._close(str(error))
                    self._complain(str(error))
                else:
                    of_use = await self._serve(link)
                    problem = "the server does not answer" if self._up.silent else ""
                    if of_use and not problem:
                        retry_s = FIRST_RETRY_S
                        continue
                    if not of_use and self._grace_s() <= 0:
                        problem = "the server closes connections at once"
                    if problem:
                        self._close(problem)
                        self._complain(problem)
                await asyncio.sleep(retry_s * (1 - 0.1 * self._rng.random()))
                retry_s = min(2 * retry_s, LAST_RETRY_S)
        finally:
            self._close("stopped")
            self._links.close()
            self._links = None

    # What the connections tell

    def on_made(self, link: Link) -> None:
        """See `Owner`."""
        self._no_attempt()
        if self._reached is not None:
            if not self._reached.done():
                self._reached.set_result(link)
            return
        self._use(link)
        self._advance()

    def on_bytes(self, link: Link, data: bytes) -> None:
        """See `Owner`."""
        self._advance(data, link)

    def on_end(self, link: Link, error: int) -> None:
        """See `Owner`."""
        if link is self._making:
            self._not_made(os.strerror(error).lower())
            return
        try:
            self._end(link, remote=True)
        except Exception as bug:  # noqa: BLE001  # as in `_advance`
            self._broken(bug)
        else:
            self._advance()

    # The first connection, by the hand of `run`

    def _grace_s(self) -> float:
        """How long the line stays open without a connection."""
        return self._lost_at + GRACE_S - self._clock.monotonic()

    async def _connect(self) -> Link:
        """A connection; PortError when there is none to be had, at the latest after `connect_timeout_s`."""
        limit_s = self._where.connect_timeout_s
        if self._open:
            limit_s = max(GRACE_RETRY_S, min(limit_s, self._grace_s()))
        try:
            async with asyncio.timeout(limit_s):
                return await self._try_addresses()
        except TimeoutError:
            raise PortError(f"no answer to the connection attempt within {limit_s:.3g} s") from None

    async def _try_addresses(self) -> Link:
        if not self._open or not self._addresses:
            self._addresses = await self._resolve()
        problem: OSError | None = None
        for address in self._addresses:
            try:
                link = await self._connect_to(address)
            except OSError as error:
                problem = error
            else:
                self._address = address
                return link
        assert problem is not None, "a name that was found has an address"
        reason = str(problem) if problem.errno is None else os.strerror(problem.errno).lower()
        raise PortError(reason) from problem

    async def _connect_to(self, address: Address) -> Link:
        link = self._new_link(address)
        if link.made:
            return link
        self._making = link
        self._reached = asyncio.get_running_loop().create_future()
        try:
            return await self._reached
        except BaseException:
            link.close()
            raise
        finally:
            self._making = self._reached = None

    async def _resolve(self) -> list[Address]:
        host, port = self._where.host, self._where.port
        with contextlib.suppress(ValueError):
            ip = ipaddress.ip_address(host)
            if isinstance(ip, ipaddress.IPv4Address):
                return [(socket.AF_INET, (host, port))]
            if ip.scope_id is None:
                return [(socket.AF_INET6, (host, port, 0, 0))]
        if self._lookup is None:  # one that took longer than its try had is waited for by the next
            self._lookup = in_thread(partial(_look_up, host, port), late=lambda _: None, name=f"look-up-{self.name}")
            self._lookup.add_done_callback(lambda done: done.cancelled() or done.exception())  # nobody may wait then
        try:
            await asyncio.wait({self._lookup})
            lookup, self._lookup = self._lookup, None
            return lookup.result()
        except OSError as error:
            raise PortError(f"{host} is not known ({error.strerror or error})") from error

    async def _serve(self, link: Link) -> bool:
        """Use the connections until there is none; False when the last was of no use (rule 2)."""
        self._gone = asyncio.get_running_loop().create_future()
        try:
            self._use(link)
            self._advance()
            return await self._gone
        finally:
            self._gone = None

    # Connections while the line is open

    def _new_link(self, address: Address) -> Link:
        assert self._links is not None, "the line runs"
        number = 0
        while number in self._used:
            number += 1
        now = self._clock.monotonic()
        return Link(self, self._links, number, address, lasting=not self._up.single_use(now), now=now)

    def _use(self, link: Link) -> None:
        """There is a connection."""
        now = self._clock.monotonic()
        link.began = now
        self._used[link.number] = link
        if self._open:
            self._up.connected(now, link.number)
        else:
            self._open = True
            self._unheard_of = True
            self._opened_at = now
            self._up.opened(now)

    def _attempt(self) -> bool:
        """Begin one more connection; whether it is there already."""
        assert self._address is not None, "there was one before"
        assert self._loop is not None, "the line runs"
        try:
            link = self._new_link(self._address)
        except OSError as error:
            self._not_made(os.strerror(error.errno or 0).lower())
            return False
        if link.made:
            self._use(link)
            return True
        limit_s = self._where.connect_timeout_s
        if not self._used:
            limit_s = max(GRACE_RETRY_S, min(limit_s, self._grace_s()))
        self._making = link
        self._making_ends = self._loop.call_later(limit_s, self._not_made, "no answer")
        return False

    def _no_attempt(self) -> None:
        self._making = None
        if self._making_ends is not None:
            self._making_ends.cancel()
            self._making_ends = None

    def _not_made(self, reason: str) -> None:
        """An attempt gave no connection."""
        if self._making is not None:
            self._making.close()
        if self._reached is not None:
            if not self._reached.done():
                self._reached.set_exception(OSError(reason))
            return
        self._no_attempt()
        self._up.upstream.refused += 1
        if self._used:
            self._fewer()
        elif self._gone is not None and not self._gone.done():
            self._gone.set_result(True)  # `run` goes on trying

    def _fewer(self) -> None:
        """Rule 8."""
        self._no_more_before = self._clock.monotonic() + self._fewer_s
        self._fewer_s = min(2 * self._fewer_s, MOST_FEWER_S)

    def _end(self, link: Link, *, remote: bool, reason: str = "") -> None:
        """A connection is over, by the other end or because the engine will have no more of it."""
        if self._used.get(link.number) is not link:
            return
        now = self._clock.monotonic()
        if reason:
            self._say_dropped(reason, now)
        if self.tap:
            self.tap.tell(now, sent=not remote, data=b"", connection=link.number)
        del self._used[link.number]
        link.close()
        self._up.lost(now, remote=remote, channel=link.number)
        of_use = link.asked or now - link.began >= AT_ONCE_S
        if of_use:
            self._lost_at = now
        elif self._used:
            self._fewer()
        if self._used or self._making is not None or self._gone is None or self._gone.done():
            return
        if not of_use or self._up.silent:
            self._gone.set_result(of_use)
        else:
            self._attempt()

    def _close(self, reason: str) -> None:
        for timer in (self._timer, self._announcing):
            if timer is not None:
                timer.cancel()
        self._timer = self._announcing = None
        if self._making is not None:
            self._making.close()
        self._no_attempt()
        for link in self._used.values():
            link.close()
        self._used.clear()
        now = self._clock.monotonic()
        if self._open:
            self._flapping = now - self._opened_at < STABLE_S
        self._open = False
        self._addresses = []
        self._engine.closed(f"{self.port}: {reason}", now)
        self._engine.step(now)  # hands out what ended with the line
        self._rest()

    # The engine's turn

    def _advance(self, data: bytes = b"", link: Link | None = None) -> None:
        """Let the engine act; its mistake ends `run`, which the service starts again, instead of hanging the line."""
        try:
            self._act(data, link)
        except Exception as error:  # noqa: BLE001  # `run` raises it
            self._broken(error)

    def _broken(self, error: Exception) -> None:
        if self._gone is None or self._gone.done():
            raise error
        self._gone.set_exception(error)

    def _act(self, data: bytes, link: Link | None) -> None:
        """Pass on bytes and time, write what the engine says, set the alarm for its next deadline."""
        engine = self._up
        self._acted_at = now = self._clock.monotonic()
        if data and link is not None:
            if self.tap:
                self.tap.tell(now, sent=False, data=data, connection=link.number)
            replies = self.stats.ok
            engine.receive(data, now, link.number)
            if self._unheard_of and self.stats.ok > replies:
                self._heard()
        engine.on_timer(now)
        self._drop()
        self._send(now)
        while self._may_have_more(now) and engine.lacks_connection(now) and self._attempt():
            self._send(now)
        self._set_alarm(engine.next_deadline(now), now)
        self._rest()

    def _drop(self) -> None:
        """End the connections that the engine will have no more of."""
        for number, reason in self._up.drops():
            self._end(self._used[number], remote=False, reason=reason)

    def _send(self, now: float) -> None:
        frames: dict[int, bytes] = {}
        while (frame := self._up.step(now)) is not None:
            number = self._up.sent_on
            frames[number] = frames[number] + frame if number in frames else frame
        for number, data in frames.items():
            if self.tap:
                self.tap.tell(now, sent=True, data=data, connection=number)
            self._used[number].write(data)

    def _may_have_more(self, now: float) -> bool:
        """Whether one more connection may be begun (rule 8)."""
        return self._making is None and 0 < len(self._used) < self._where.connections and now >= self._no_more_before

    def _heard(self) -> None:
        """The first reply since the line was opened."""
        self._unheard_of = False
        self._fewer_s = FEWER_S
        if self._loop is not None:
            self._announcing = self._loop.call_later(STABLE_S if self._flapping else 0.0, self._announce)

    def _set_alarm(self, deadline: float | None, now: float) -> None:
        if deadline is None or self._loop is None:
            return
        if self._timer is not None:
            if self._deadline <= deadline + EARLY_S:
                return  # it looks again when it goes off
            self._timer.cancel()
        self._deadline = deadline
        self._timer = self._loop.call_later(min(LONGEST_ALARM_S, max(0.0, deadline - now)), self._on_timer)

    def _on_timer(self) -> None:
        self._timer = None
        self._advance()

    def _say_dropped(self, reason: str, now: float) -> None:
        said_at = self._said_at.get(reason)
        if said_at is None or now - said_at >= SAY_AGAIN_S:
            self._said_at[reason] = now
            log.warning('event=upstream_dropped line=%s port="%s" reason=%s', self.name, self.port, reason)


def _look_up(host: str, port: int) -> list[Address]:
    """All addresses of a name; blocks. OSError when it has none."""
    found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
    return [(int(family), address) for family, _, _, _, address in found]  # type: ignore[misc]  # of IPv4 and IPv6 only
