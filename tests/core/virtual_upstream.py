"""An upstream engine and a simulated Modbus TCP server on one virtual clock."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from random import Random
from typing import Any

from gateway.core.requests import Lane, Waiter
from gateway.core.settings import LineSettings, UpstreamSettings
from gateway.core.site import Device, Outcome
from gateway.core.upstream import UpstreamEngine
from gateway.modbus.mbap import Adu, MbapSplitter
from gateway.simulator.upstream import ServerConnection, SimulatedServer
from tests.core.virtual_line import end_of

RECONNECT_S = 0.002
FEWER_S = 1.0


class VirtualUpstream:
    """What a shell does: connects, moves bytes and time, ends connections, connects again; nothing waits."""

    def __init__(self, server: SimulatedServer, devices: Sequence[Device], settings: LineSettings) -> None:
        self.now = 1000.0
        self.server = server
        self.devices = list(devices)
        self.engine = UpstreamEngine(settings, devices, self.now, Random(1))
        self.sent: list[tuple[float, Adu]] = []
        self.most_under_way = 0
        self.after_step: Callable[[], None] = lambda: None
        self._connections: dict[int, ServerConnection] = {}
        self._connect_at = self.now
        self._no_more_before = -math.inf
        self._asked: set[int] = set()  # the connections that something went out on
        self._open = False

    def run(self, seconds: float) -> None:
        """Let `seconds` pass."""
        end = self.now + seconds
        while True:
            self._connect()
            self._write()
            moments = [self.engine.next_deadline(self.now), math.inf if self._connections else self._connect_at]
            moments += [connection.next_event() for connection in self._connections.values()]
            moment = min(moment for moment in moments if moment is not None)
            if moment > end:
                self.now = end
                return
            self.now = max(self.now, moment)
            for number, connection in list(self._connections.items()):
                data = connection.take(self.now)
                if data:
                    self.engine.receive(data, self.now, number)
                if connection.ended:
                    self._lose(number, remote=True)
            self.engine.on_timer(self.now)
            for number, _ in self.engine.drops():
                self._lose(number, remote=False)
            self.after_step()

    def read(
        self, device: int, pdu: bytes, done: Callable[[Outcome], None], *, client: str = "", lane: Lane = Lane.CLIENT
    ) -> Waiter:
        """Read as a client does."""
        return self.engine.read(self.devices[device], pdu, done, self.now, client=client, lane=lane)

    def ask(self, device: int, pdu: bytes, wait_s: float = 30.0) -> Outcome:
        """Read and wait for the outcome."""
        outcomes: list[Outcome] = []
        self.read(device, pdu, outcomes.append)
        return end_of(outcomes, self, wait_s)

    def write(self, device: int, pdu: bytes, wait_s: float = 30.0) -> Outcome:
        """Write and wait for the outcome."""
        outcomes: list[Outcome] = []
        self.engine.write(self.devices[device], pdu, outcomes.append, self.now, client="")
        return end_of(outcomes, self, wait_s)

    def reset(self) -> None:
        """The connections break now."""
        for number in list(self._connections):
            self._lose(number, remote=True)

    def units_asked(self) -> Counter[int]:
        """How many requests went out to each unit."""
        return Counter(adu.unit for _, adu in self.sent)

    def _connect(self) -> None:
        if self._connections or self.now < self._connect_at:
            return
        if self.server.refusing:
            if self._open:
                self.engine.closed("refused", self.now)
                self._open = False
            self._connect_at = self.now + 0.5
            return
        self._connections[0] = self.server.connect()
        if self._open:
            self.engine.connected(self.now)
        else:
            self.engine.opened(self.now)
            self._open = True

    def _connect_more(self) -> bool:
        """One more connection, where a request waits for it."""
        if not self._connections or self.now < self._no_more_before or not self.engine.lacks_connection(self.now):
            return False
        number = next(number for number in range(len(self._connections) + 1) if number not in self._connections)
        self._connections[number] = self.server.connect()
        self.engine.connected(self.now, number)
        return True

    def _lose(self, number: int, *, remote: bool) -> None:
        connection = self._connections.pop(number, None)
        if connection is not None:
            connection.client_closed()
        self.engine.lost(self.now, remote=remote, channel=number)
        if number not in self._asked:
            self._no_more_before = self.now + FEWER_S
        self._asked.discard(number)
        if self._connections:
            return
        self._connect_at = self.now + RECONNECT_S
        if self.engine.silent:
            self.engine.closed("silent", self.now)
            self._open = False
            self._connect_at = self.now + 0.5

    def _write(self) -> None:
        while (frame := self.engine.step(self.now)) is not None or self._connect_more():
            if frame is None:
                continue
            self.sent += [(self.now, adu) for adu in MbapSplitter().feed(frame)]
            self._asked.add(self.engine.sent_on)
            self._connections[self.engine.sent_on].receive(frame, self.now)
        stats = self.engine.stats
        self.most_under_way = max(self.most_under_way, stats.sent - stats.ok - stats.failed.total())


def make_upstream(
    server: SimulatedServer, devices: Sequence[Device], *, pipelining: int = 8, connections: int = 1, **settings: Any
) -> VirtualUpstream:
    """An engine with these devices on that server; `settings` are those of LineSettings."""
    upstream = UpstreamSettings("virtual", 502, pipelining=pipelining, connections=connections)
    line = LineSettings(name="line", index=1, port="tcp://virtual:502", upstream=upstream, **settings)
    return VirtualUpstream(server, devices, line)
