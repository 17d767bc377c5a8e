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

RECONNECT_S = 0.002


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
        self._connection: ServerConnection | None = None
        self._connect_at = self.now
        self._open = False

    def run(self, seconds: float) -> None:
        """Let `seconds` pass."""
        end = self.now + seconds
        while True:
            self._connect()
            self._write()
            connection = self._connection
            moments = [self.engine.next_deadline(self.now), math.inf if connection else self._connect_at]
            moments.append(connection.next_event() if connection else None)
            moment = min(moment for moment in moments if moment is not None)
            if moment > end:
                self.now = end
                return
            self.now = max(self.now, moment)
            if connection is not None:
                data = connection.take(self.now)
                if data:
                    self.engine.receive(data, self.now)
                if connection.ended:
                    self._lose(remote=True)
            self.engine.on_timer(self.now)
            if self.engine.drop is not None:
                self._lose(remote=False)
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
        return self._await(outcomes, wait_s)

    def write(self, device: int, pdu: bytes, wait_s: float = 30.0) -> Outcome:
        """Write and wait for the outcome."""
        outcomes: list[Outcome] = []
        self.engine.write(self.devices[device], pdu, outcomes.append, self.now, client="")
        return self._await(outcomes, wait_s)

    def reset(self) -> None:
        """The connection breaks now."""
        self._lose(remote=True)

    def units_asked(self) -> Counter[int]:
        """How many requests went out to each unit."""
        return Counter(adu.unit for _, adu in self.sent)

    def _await(self, outcomes: list[Outcome], wait_s: float) -> Outcome:
        end = self.now + wait_s
        while not outcomes and self.now < end:
            self.run(0.01)
        assert len(outcomes) == 1, "every request ends, once"
        return outcomes[0]

    def _connect(self) -> None:
        if self._connection is not None or self.now < self._connect_at:
            return
        if self.server.refusing:
            if self._open:
                self.engine.closed("refused", self.now)
                self._open = False
            self._connect_at = self.now + 0.5
            return
        self._connection = self.server.connect()
        if self._open:
            self.engine.connected(self.now)
        else:
            self.engine.opened(self.now)
            self._open = True

    def _lose(self, *, remote: bool) -> None:
        if self._connection is not None:
            self._connection.client_closed()
        self._connection = None
        self._connect_at = self.now + RECONNECT_S
        self.engine.lost(self.now, remote=remote)
        if self.engine.silent:
            self.engine.closed("silent", self.now)
            self._open = False
            self._connect_at = self.now + 0.5

    def _write(self) -> None:
        while (frame := self.engine.step(self.now)) is not None:
            self.sent += [(self.now, adu) for adu in MbapSplitter().feed(frame)]
            assert self._connection is not None, "nothing goes out without a connection"
            self._connection.receive(frame, self.now)
        stats = self.engine.stats
        self.most_under_way = max(self.most_under_way, stats.sent - stats.ok - stats.failed.total())


def make_upstream(
    server: SimulatedServer, devices: Sequence[Device], *, pipelining: int = 8, **settings: Any
) -> VirtualUpstream:
    """An engine with these devices on that server; `settings` are those of LineSettings."""
    upstream = UpstreamSettings("virtual", 502, pipelining=pipelining)
    line = LineSettings(name="line", index=1, port="tcp://virtual:502", upstream=upstream, **settings)
    return VirtualUpstream(server, devices, line)
