"""A line engine and a simulated line on one virtual clock."""

from __future__ import annotations

import math
from collections.abc import Callable
from random import Random
from typing import Any, Protocol

from gateway.core.engine import LineEngine
from gateway.core.identity import Identity
from gateway.core.requests import Lane, Waiter
from gateway.core.settings import LineSettings
from gateway.core.site import Device, Outcome
from gateway.devices.schema import load_map
from gateway.simulator.line import SimulatedLine, Station


class Timed(Protocol):
    """Something that lives in virtual time."""

    now: float

    def run(self, seconds: float) -> None:
        """Let `seconds` pass."""
        ...


def end_of(outcomes: list[Outcome], line: Timed, wait_s: float) -> Outcome:
    """The one outcome that a request has, within `wait_s`."""
    until = line.now + wait_s
    while not outcomes and line.now < until:
        line.run(0.01)
    assert len(outcomes) == 1, "every request ends, once"
    return outcomes[0]


class VirtualLine:
    """Moves bytes and time between an engine and a simulated line; nothing waits, nothing is threaded."""

    def __init__(self, settings: LineSettings, devices: list[Device], wire: SimulatedLine, start: float) -> None:
        self.now = start
        self.devices = devices
        self.wire = wire
        self.engine = LineEngine(settings, devices, start, Random(1))
        self.sent: list[tuple[float, bytes]] = []
        self.after_step: Callable[[], None] = lambda: None

    def run(self, seconds: float) -> None:
        """Let `seconds` pass."""
        end = self.now + seconds
        while True:
            frame = self.engine.step(self.now)
            if frame is not None:
                self.sent.append((self.now, frame))
                self.wire.receive(frame, self.now)
            moments = (self.engine.next_deadline(self.now), self.wire.next_event())
            moment = min((moment for moment in moments if moment is not None), default=math.inf)
            if moment > end:
                self.now = end
                return
            self.now = max(self.now, moment)
            data = self.wire.take(self.now)
            if data:
                self.engine.receive(data, self.now)
            self.engine.on_timer(self.now)
            self.after_step()

    def read(
        self, device: Device, pdu: bytes, done: Callable[[Outcome], None], client: str = "", lane: Lane = Lane.CLIENT
    ) -> Waiter:
        """Read as a client does."""
        return self.engine.read(device, pdu, done, self.now, client=client, lane=lane)

    def write(self, device: Device, pdu: bytes, done: Callable[[Outcome], None], client: str = "") -> Waiter:
        """Write as a client does."""
        return self.engine.write(device, pdu, done, self.now, client=client)

    def ask(self, device: Device, pdu: bytes, wait_s: float = 10.0) -> Outcome:
        """Read as a client does and wait for the outcome."""
        outcomes: list[Outcome] = []
        self.read(device, pdu, outcomes.append)
        return end_of(outcomes, self, wait_s)


def make_line(
    *stations: Station, opened: bool = True, expected: Identity | None = None, **settings: Any
) -> VirtualLine:
    """An engine with one device a station on one line; `settings` are those of LineSettings."""
    line_settings = LineSettings(name="line", index=1, port="virtual", **settings)
    devices = [
        Device(f"array-{index}", 10 + index, station.address, load_map("prostar-mppt"), expected=expected or Identity())
        for index, station in enumerate(stations, 1)
    ]
    line = VirtualLine(line_settings, devices, SimulatedLine(stations), start=1000.0)
    if opened:
        line.engine.opened(line.now)
    return line


MakeLine = Callable[..., VirtualLine]
