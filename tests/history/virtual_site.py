"""The real keeper and engine over simulated controllers, all on one virtual clock; SQLite is real."""

from __future__ import annotations

import asyncio
import heapq
import math
from collections.abc import Callable
from concurrent.futures import Executor, Future
from pathlib import Path
from random import Random
from typing import Any, Self

from gateway.core.engine import LineEngine
from gateway.core.requests import Lane
from gateway.core.settings import LineSettings, PollSettings
from gateway.core.site import Device, LineStatus, Outcome, Site, Ticket
from gateway.core.stats import HistoryStats, LineStats
from gateway.history.keeper import HistoryKeeper
from gateway.history.session import Session
from gateway.history.settings import HistorySettings
from gateway.simulator.line import SimulatedLine, Station
from tests.history.blocks import MAP


class InlineExecutor(Executor):
    """Runs at once, so that virtual time never waits for a real thread."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:  # noqa: BLE001  # handed to whoever waits
            future.set_exception(error)
        return future


class VirtualClock:
    """Monotonic time of the test, and a wall clock that a test may set."""

    def __init__(self) -> None:
        self.now = 1000.0
        self.wall_offset = 1_795_000_000.0

    def monotonic(self) -> float:
        return self.now

    def wall(self) -> float:
        return self.now + self.wall_offset


class VirtualPort:
    """A `LinePort` over an engine and a simulated line."""

    def __init__(
        self,
        clock: VirtualClock,
        stations: list[Station],
        live_s: float,
        name: str = "shelter-a",
        settings_s: float = 300.0,
    ) -> None:
        settings = LineSettings(name=name, index=1, port="virtual", poll=PollSettings(live_s, settings_s))
        self.name, self.index, self.port = name, 1, "virtual"
        self.clock = clock
        self.wire = SimulatedLine(stations)
        self.devices = [
            Device(f"array-{number}", 10 + number, station.address, MAP) for number, station in enumerate(stations, 1)
        ]
        self.engine = LineEngine(settings, self.devices, clock.now, Random(1))
        self.sent: list[tuple[float, bytes]] = []
        for device in self.devices:
            device.line = self

    @property
    def stats(self) -> LineStats:
        return self.engine.stats

    def status(self, now: float) -> LineStatus:
        return self.engine.status(now)

    def read(
        self, device: Device, pdu: bytes, done: Callable[[Outcome], None], *, client: str = "", background: bool = False
    ) -> Ticket:
        lane = Lane.BACKGROUND if background else Lane.CLIENT
        return self.engine.read(device, pdu, done, self.clock.now, client=client, lane=lane)

    def write(self, device: Device, pdu: bytes, done: Callable[[Outcome], None], *, client: str = "") -> Ticket:
        raise AssertionError("the history writes nothing")

    def step(self) -> None:
        """Everything that is due now."""
        data = self.wire.take(self.clock.now)
        if data:
            self.engine.receive(data, self.clock.now)
        self.engine.on_timer(self.clock.now)
        frame = self.engine.step(self.clock.now)
        if frame is not None:
            self.sent.append((self.clock.now, frame))
            self.wire.receive(frame, self.clock.now)

    def next_moment(self) -> float:
        moments = (self.engine.next_deadline(self.clock.now), self.wire.next_event())
        return min((moment for moment in moments if moment is not None), default=math.inf)


class VirtualGateway:
    """One run of a gateway: `async with`, then `run(seconds)`; may be left and entered again with the same parts."""

    def __init__(
        self,
        directory: Path,
        clock: VirtualClock,
        port: VirtualPort,
        interval_s: float = 86400.0,
        session: Session | None = None,
    ) -> None:
        self.clock = clock
        self.port = port
        self.stats = HistoryStats()
        self._sleepers: list[tuple[float, int, asyncio.Future[None]]] = []
        self._number = 0
        self.keeper = HistoryKeeper(
            HistorySettings(directory, interval_s),
            Site.of("ridge-07", [port], port.devices),
            clock,
            self.stats,
            sleep=self._sleep,
            executor=InlineExecutor,
            session=session,
        )
        self._task: asyncio.Task[None] | None = None

    async def _sleep(self, seconds: float) -> None:
        self._number += 1
        future: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        heapq.heappush(self._sleepers, (self.clock.now + seconds, self._number, future))
        await future

    async def __aenter__(self) -> Self:
        self.port.engine.opened(self.clock.now)
        self._task = asyncio.create_task(self.keeper.run())
        return self

    async def __aexit__(self, *_error: object) -> None:
        assert self._task is not None
        self.port.engine.closed("stopped", self.clock.now)
        self._task.cancel()
        await asyncio.gather(self._task, return_exceptions=True)

    async def run(self, seconds: float) -> None:
        """Let so much virtual time pass."""
        end = self.clock.now + seconds
        while True:
            self.port.step()
            await self._settle()
            sleeper = self._sleepers[0][0] if self._sleepers else math.inf
            moment = min(self.port.next_moment(), sleeper)
            if moment > end:
                self.clock.now = end
                return
            self.clock.now = max(self.clock.now, moment)
            while self._sleepers and self._sleepers[0][0] <= self.clock.now:
                future = heapq.heappop(self._sleepers)[2]
                if not future.done():
                    future.set_result(None)

    async def until(self, condition: Callable[[], object], seconds: float = 600.0) -> None:
        """Let time pass until it is true; fails after so much virtual time."""
        end = self.clock.now + seconds
        while not condition():
            assert self.clock.now < end, "waited in vain"
            await self.run(0.5)

    async def _settle(self) -> None:
        """Let every coroutine go as far as it can at this moment."""
        assert self._task is not None
        for _ in range(12):
            await asyncio.sleep(0)
        if self._task.done():
            self._task.result()
