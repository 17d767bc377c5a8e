"""One controller whose registers a test holds in its hand, its line and the gateway's metrics, on one virtual clock."""

from __future__ import annotations

import asyncio
import re
from collections.abc import Callable, Mapping
from random import Random

from gateway.core.engine import LineEngine
from gateway.core.settings import LineSettings, PollSettings
from gateway.core.site import Device, LineState, LineStatus, Outcome, Site, Ticket
from gateway.core.stats import LineStats
from gateway.devices.model import Space, Value
from gateway.devices.schema import load_map
from gateway.faces.http.exposition import Exposition
from gateway.faces.http.own import Counts
from gateway.faces.http.text import TEXT
from gateway.simulator.chaos import Chaos
from gateway.simulator.line import SimulatedLine
from gateway.simulator.memory import Memory
from gateway.simulator.server import Controller

MODEL = "prostar-mppt"
START: Mapping[str, Value] = {
    "software_version": 13,
    "settings_voltage_multiplier": 1,
    "battery_voltage": 12.5,
    "charge_state": 5,
    "charge_total": 1000,
    "hourmeter": 5000,
}


class HeldController(Controller):
    """Registers that change only by the test's hand."""

    def __init__(self, values: Mapping[str, Value]) -> None:
        super().__init__(load_map(MODEL), address=1, turnaround_s=0.015)
        self.memory = Memory(self.map)
        self.reads = 0
        for name, value in values.items():
            self.memory.set(name, value)

    def identification(self) -> Mapping[int, bytes]:
        return {0: b"Morningstar Corp.", 1: b"PS-MPPT-40", 2: b"v01.01.13"}

    def read(self, space: Space, first: int, count: int, now: float) -> list[int]:
        self.reads += 1
        return self.memory.read(space, first, count)

    def write(self, space: Space, address: int, value: int, now: float) -> bool:
        raise AssertionError("nothing here writes")


class VirtualLine:
    """The line as the faces see it; they do not read it."""

    name = "shelter-a"
    index = 1
    port = "virtual"

    def __init__(self, engine: Callable[[], LineEngine]) -> None:
        self._engine = engine

    @property
    def stats(self) -> LineStats:
        return self._engine().stats

    def status(self, now: float) -> LineStatus:
        return LineStatus(LineState.OPEN, 0.0, "", 0, 0.0)

    def read(
        self, device: Device, pdu: bytes, done: Callable[[Outcome], None], *, client: str = "", background: bool = False
    ) -> Ticket:
        raise AssertionError("a scrape read the line")

    def write(self, device: Device, pdu: bytes, done: Callable[[Outcome], None], *, client: str = "") -> Ticket:
        raise AssertionError("a scrape wrote")


class Plant:
    """See the module; it is its own clock."""

    def __init__(self) -> None:
        self.now = 1000.0
        self.controller = HeldController(START)
        settings = LineSettings(
            name="shelter-a", index=1, port="virtual", poll=PollSettings(live_s=1.0, settings_s=30.0)
        )
        self._wire = SimulatedLine([self.controller], timing=settings.timing(), medium=Chaos(0))
        self.device = Device("array-1", 11, 1, self.controller.map)
        self.engine = LineEngine(settings, [self.device], self.now, Random(1))
        self.device.line = VirtualLine(lambda: self.engine)
        self.engine.opened(self.now)
        self._exposition = Exposition(Site.of("ridge-07", [self.device.line], [self.device]), self, Counts())

    def monotonic(self) -> float:
        return self.now

    def wall(self) -> float:
        return 1_700_000_000.0 + self.now

    def run(self, seconds: float) -> None:
        """Let time pass."""
        end = self.now + seconds
        while True:
            out = self.engine.step(self.now)
            if out is not None:
                self._wire.receive(out, self.now)
            moments = (self.engine.next_deadline(self.now), self._wire.next_event())
            moment = min(moment for moment in moments if moment is not None)
            if moment > end:
                self.now = end
                return
            self.now = max(self.now, moment)
            data = self._wire.take(self.now)
            if data:
                self.engine.receive(data, self.now)
            self.engine.on_timer(self.now)

    def scrape(self) -> dict[str, float]:
        """Sample name with its label beyond the device's → number."""

        async def whole() -> bytes:
            return b"".join([piece async for piece in self._exposition.pieces(TEXT)])

        found = {}
        for line in asyncio.run(whole()).decode().splitlines():
            match = re.fullmatch(r'(\w+)(?:\{(?:.*?unit_id="11")?,?(.*)\})? (\S+)', line)
            if match is not None:
                extra = re.sub(r'.*="(.*)"', r"{\1}", match[2]) if match[2] else ""
                found[match[1] + extra] = float(match[3])
        return found
