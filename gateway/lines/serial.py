"""The asyncio shell that owns one serial port.

It makes no decision: it opens the port, moves bytes and time between the port (transports.py) and the
`LineEngine`, and opens the port again after a failure.

Rule 1: nothing here blocks the loop; ports are opened and closed in threads.
Rule 2: a port that failed is opened again after 0.1 s, then after twice as long each time up to 4.5 s, so that one
        that is plugged in again is in use within 5 s. Bytes of the first 0.2 s are dropped: adapters spit.
Rule 3: a request goes out when the gap is over and not a timer's rounding later: the last millisecond is spent in
        turns of the loop, which go on serving everybody else.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Sequence
from functools import partial
from random import Random

import serial

from gateway.clock import Clock
from gateway.core.engine import LineEngine
from gateway.core.settings import LineSettings
from gateway.core.site import Device
from gateway.errors import PortError
from gateway.lines.ports import close_port, open_port
from gateway.lines.shell import LONGEST_ALARM_S, STABLE_S, LineShell
from gateway.lines.threads import in_thread
from gateway.lines.transports import Transport, transport_for

log = logging.getLogger(__name__)

FIRST_RETRY_S = 0.1
LAST_RETRY_S = 4.5
SETTLE_S = 0.2
CLOSE_S = 1.0  # longer than that nobody waits for a port to close
PRECISE_S = 0.0005  # timers are late or early by up to that


class SerialLine(LineShell):
    """One serial line: satisfies `core.site.LinePort`."""

    def __init__(
        self, settings: LineSettings, devices: Sequence[Device], clock: Clock, rng: Random | None = None
    ) -> None:
        self._rng = rng if rng is not None else Random()  # noqa: S311  # jitter, not secrets
        super().__init__(LineEngine(settings, devices, clock.monotonic(), self._rng), devices, clock)
        self._char_s = settings.timing().char_s
        self._loop: asyncio.AbstractEventLoop | None = None
        self._timer: asyncio.Handle | None = None
        self._deadline = 0.0  # what the timer is for
        self._reply_by = 0.0  # the end of the wait for the reply under way, or sooner
        self._port: Transport | None = None
        self._failed: asyncio.Future[str] | None = None
        self._acted_at = 0.0  # when the engine last had its turn

    def overdue_s(self, now: float) -> float:
        """How long the engine has had something to do and was not let; 0 while the port is not open."""
        if self._port is None or self._engine.next_deadline(now) is None:
            return 0.0
        return max(0.0, now - max(self._deadline, self._acted_at))

    async def run(self) -> None:
        """Own the port until cancelled: open it, serve it, and open it again when it fails."""
        self._loop = asyncio.get_running_loop()
        retry_s = FIRST_RETRY_S
        try:
            while True:
                try:
                    port = await in_thread(partial(open_port, self.settings), late=close_port, name=f"open-{self.name}")
                except PortError as error:
                    self._close(str(error))
                    self._complain(str(error))
                else:
                    if await self._serve(port) >= STABLE_S:
                        retry_s = FIRST_RETRY_S
                await asyncio.sleep(retry_s * (1 - 0.1 * self._rng.random()))
                retry_s = min(2 * retry_s, LAST_RETRY_S)
        finally:
            self._close("stopped")

    async def _serve(self, port: serial.Serial) -> float:
        """Move bytes until the port fails; gives how many seconds it was in use."""
        loop = asyncio.get_running_loop()
        self._failed = loop.create_future()
        transport = transport_for(port, loop, self, char_s=self._char_s, name=self.name)
        announcing: asyncio.TimerHandle | None = None
        up_s = 0.0
        reason = "stopped"
        try:
            transport.start()
            await asyncio.wait({self._failed}, timeout=SETTLE_S)
            if not self._failed.done():
                up_at = self._clock.monotonic()
                announcing = loop.call_later(STABLE_S if self._flapping else 0.0, self._announce)
                self._port = transport
                self._engine.opened(up_at)
                self._advance()
                await asyncio.wait({self._failed})
                up_s = self._clock.monotonic() - up_at
            reason = self._failed.result()
        finally:
            self._port = None
            transport.stop()
            if announcing is not None:
                announcing.cancel()
            self._close(reason)
            closing = in_thread(partial(close_port, port), late=lambda _none: None, name=f"close-{self.name}")
            await asyncio.wait({closing}, timeout=CLOSE_S)
        self._flapping = up_s < STABLE_S
        self._complain(reason)
        return up_s

    def _close(self, reason: str) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self._engine.closed(reason, self._clock.monotonic())
        self._engine.step(self._clock.monotonic())  # hands out what ended with the line
        self._rest()

    def on_bytes(self, data: bytes) -> None:
        """See `Owner.on_bytes`; before the line is open they are dropped."""
        if self._port is not None:
            self._advance(data)

    def on_failure(self, reason: str) -> None:
        """See `Owner.on_failure`; `run` takes over."""
        if self._failed is not None and not self._failed.done():
            self._failed.set_result(f"{self.port}: {reason}")

    def bytes_due(self) -> int:
        """See `Owner.bytes_due`."""
        return self._engine.bytes_due()

    def _advance(self, data: bytes = b"") -> None:
        """Let the engine act; its mistake ends `run`, which the service starts again, instead of hanging the line."""
        try:
            self._act(data)
        except Exception as error:
            if self._failed is None or self._failed.done():
                raise
            self._failed.set_exception(error)

    def _act(self, data: bytes) -> None:
        """Pass on bytes and time, write what the engine says, set the alarm for its next deadline."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self._acted_at = now = self._clock.monotonic()
        if data:
            if self.tap:
                self.tap.tell(now, sent=False, data=data)
            self._engine.receive(data, now)
        self._engine.on_timer(now)
        frame = self._engine.step(now)
        if frame is not None and self._port is not None:
            if self.tap:
                self.tap.tell(now, sent=True, data=frame)
            self._port.write(frame)
        deadline = self._engine.next_deadline(now)
        if frame is not None:
            self._reply_by = now if deadline is None else deadline
        if deadline is not None and self._loop is not None:
            self._set_alarm(deadline, self._loop)
        self._rest()

    def _set_alarm(self, deadline: float, loop: asyncio.AbstractEventLoop) -> None:
        now = self._clock.monotonic()
        due = self._engine.bytes_due()
        if due:  # nothing is to be done while a reply is still coming in, unless the wait for it is over
            deadline = max(deadline, min(self._reply_by, now + due * self._char_s))
        self._deadline = deadline
        delay_s = min(deadline - now, LONGEST_ALARM_S)
        if due:  # and a time-out need not be precise
            self._timer = loop.call_later(max(0.0, delay_s), self._on_timer)
        elif delay_s > PRECISE_S:
            self._timer = loop.call_later(delay_s - PRECISE_S, self._on_timer)
        else:
            self._timer = loop.call_soon(self._on_timer)

    def _on_timer(self) -> None:
        now = self._clock.monotonic()
        if now < self._deadline and self._loop is not None:
            self._set_alarm(self._deadline, self._loop)
            return
        self._timer = None
        # A reply that is there counts, although the reader sleeps: what looked like its head may have been noise.
        self._advance(self._port.take() if self._port is not None and now >= self._reply_by else b"")
