"""What the shells of all lines share: they satisfy `core.site.LinePort`, and say when a line goes down and is up again.

Rule 1: one log line when the line goes down, or cannot be opened for another reason than before, and one when it is
        up. A line that is lost again and again within seconds is no news until it stays.
"""

from __future__ import annotations

import asyncio
import logging
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence

from gateway.clock import Clock
from gateway.core.engine import LineEngine
from gateway.core.requests import Lane
from gateway.core.settings import LineSettings
from gateway.core.site import Device, LineStatus, Outcome, Ticket
from gateway.core.stats import LineStats
from gateway.lines.tap import Tap

log = logging.getLogger(__name__)

STABLE_S = 5.0
"""A line that stayed up so long works."""
LONGEST_ALARM_S = 5.0
"""A timer does not run while the machine sleeps: after that long a line looks at the clock again."""
SAID = 16
"""Reasons that are remembered."""


class LineShell(ABC):
    """Owner of an engine; a subclass moves bytes and time."""

    def __init__(self, engine: LineEngine, devices: Sequence[Device], clock: Clock) -> None:
        self.settings: LineSettings = engine.settings
        self._clock = clock
        self._engine = engine
        self.tap = Tap()
        self._wake: asyncio.Handle | None = None
        self._idle: asyncio.Future[None] | None = None  # somebody waits until nothing is under way
        self._down_at: float | None = None
        self._said: set[str] = set()  # why it is down, as logged since it was up
        self._flapping = False  # it was lost within seconds the last time
        for device in devices:
            device.line = self

    @property
    def name(self) -> str:
        """See `LinePort.name`."""
        return self.settings.name

    @property
    def index(self) -> int:
        """See `LinePort.index`."""
        return self.settings.index

    @property
    def port(self) -> str:
        """See `LinePort.port`."""
        return self.settings.port

    @property
    def stats(self) -> LineStats:
        """See `LinePort.stats`."""
        return self._engine.stats

    def status(self, now: float) -> LineStatus:
        """See `LinePort.status`."""
        return self._engine.status(now)

    def read(
        self, device: Device, pdu: bytes, done: Callable[[Outcome], None], *, client: str = "", background: bool = False
    ) -> Ticket:
        """See `LinePort.read`."""
        lane = Lane.BACKGROUND if background else Lane.CLIENT
        ticket = self._engine.read(device, pdu, done, self._clock.monotonic(), client=client, lane=lane)
        self._wake_up()
        return ticket

    def write(self, device: Device, pdu: bytes, done: Callable[[Outcome], None], *, client: str = "") -> Ticket:
        """See `LinePort.write`."""
        ticket = self._engine.write(device, pdu, done, self._clock.monotonic(), client=client)
        self._wake_up()
        return ticket

    def adjust(self, settings: LineSettings) -> None:
        """Go on by other settings of the same wire; it stays open and what is under way is not disturbed."""
        self.settings = settings
        self._engine.adjust(settings, self._clock.monotonic())
        self._wake_up()

    async def finish(self) -> None:
        """Begin nothing more, answer 06 to what waits, return when nothing is under way."""
        self._engine.finish()
        self._idle = asyncio.get_running_loop().create_future()
        self._advance()
        await self._idle

    def _rest(self) -> None:
        """Tell who waits for it that nothing is under way."""
        if self._idle is not None and not self._idle.done() and not self._engine.busy:
            self._idle.set_result(None)

    def _wake_up(self) -> None:
        if self._wake is None:
            self._wake = asyncio.get_running_loop().call_soon(self._woken)

    def _woken(self) -> None:
        self._wake = None
        self._advance()

    @abstractmethod
    def _advance(self, data: bytes = b"") -> None:
        """Let the engine act on these bytes and the time."""

    def _complain(self, reason: str) -> None:
        if self._down_at is None:
            self._down_at = self._clock.monotonic()
        if reason not in self._said:
            if len(self._said) < SAID:
                self._said.add(reason)
            log.error('event=line_down line=%s reason="%s"', self.name, reason)

    def _announce(self) -> None:
        lasted = "" if self._down_at is None else f" down_s={self._clock.monotonic() - self._down_at:.1f}"
        log.info('event=line_up line=%s port="%s"%s', self.name, self.port, lasted)
        self._down_at = None
        self._said.clear()
