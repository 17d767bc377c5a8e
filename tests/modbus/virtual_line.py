"""A line in virtual time: bytes arrive when the wire has carried them, cut as an adapter would cut them."""

from __future__ import annotations

import heapq
import math
from collections.abc import Sequence
from enum import Enum

from gateway.modbus.counters import RtuCounters
from gateway.modbus.crc import append_crc
from gateway.modbus.pdu import ReadRequest
from gateway.modbus.rtu import RtuClient, State, Timing
from gateway.modbus.transactions import Failed, Replied

TIMING = Timing.of(9600, 8, "N", 2)
QUARANTINE_S = 0.1
TIMEOUT_S = 0.5
ADAPTER_BATCH_S = 0.016

Event = Replied | Failed


class Cut(Enum):
    """How received bytes are handed over."""

    JOINED = "joined"
    BATCHES = "16 ms batches"
    BYTES = "1-byte reads"


def read(first: int = 0, count: int = 2, function: int = 3) -> bytes:
    return ReadRequest(function, first, count).encode()


def registers(*values: int, address: int = 1, function: int = 3) -> bytes:
    data = b"".join(value.to_bytes(2, "big") for value in values)
    return append_crc(bytes((address, function, len(data))) + data)


class VirtualLine:
    """Runs an RtuClient; `now` only moves here."""

    def __init__(self, cut: Cut = Cut.BYTES, quarantine_s: float = QUARANTINE_S, now: float = 1000.0) -> None:
        self.cut = cut
        self.now = now
        self.counters = RtuCounters()
        self.client = RtuClient(TIMING, self.counters, quarantine_s=quarantine_s)
        self.events: list[Event] = []
        self._arrivals: list[tuple[float, int, bytes]] = []
        self._order = 0

    def arrive(self, at: float, data: bytes) -> None:
        """The first bit of `data` is on the wire at `at`."""
        if self.cut is Cut.JOINED:
            self._push(at + TIMING.wire_s(len(data)), data)
            return
        for index, byte in enumerate(data):
            done = at + TIMING.wire_s(index + 1)
            if self.cut is Cut.BATCHES:
                done = math.ceil(done / ADAPTER_BATCH_S) * ADAPTER_BATCH_S
            self._push(done, bytes((byte,)))

    def _push(self, at: float, data: bytes) -> None:
        self._order += 1
        heapq.heappush(self._arrivals, (at, self._order, data))

    def run(self, until: float) -> None:
        """Let time pass up to `until`, handing over bytes and calling timers in their order."""
        while True:
            deadline = self.client.next_deadline()
            timer_at = math.inf if deadline is None else deadline
            bytes_at = self._arrivals[0][0] if self._arrivals else math.inf
            if min(timer_at, bytes_at) > until:
                break
            self.now = max(self.now, min(timer_at, bytes_at))
            if bytes_at <= timer_at:
                event = self.client.receive(self._take(bytes_at), self.now)
            else:
                event = self.client.on_timer(self.now)
            if event is not None:
                self.events.append(event)
        self.now = max(self.now, until)

    def _take(self, at: float) -> bytes:
        data = b""
        while self._arrivals and self._arrivals[0][0] == at:
            data += heapq.heappop(self._arrivals)[2]
        return data

    def send(self, pdu: bytes, address: int = 1) -> float:
        """Send as soon as the line is free; gives the time at which our transmission has ended."""
        while (ready := self.client.ready_at(self.now)) > self.now:
            self.run(ready)
        return self.now + TIMING.wire_s(len(self.client.send(address, pdu, self.now, TIMEOUT_S)))

    def ask(self, pdu: bytes, *arrivals: tuple[float, bytes], address: int = 1) -> Event:
        """One transaction; each arrival is (seconds after the end of our transmission, bytes)."""
        sent = self.send(pdu, address)
        for delay, data in arrivals:
            self.arrive(sent + delay, data)
        return self.finish()

    def finish(self) -> Event:
        """Run until the transaction on the wire has ended; bytes that come later stay under way."""
        before = len(self.events)
        while len(self.events) == before:
            assert self.client.state is State.WAITING
            deadline = self.client.next_deadline()
            assert deadline is not None
            self.run(min([deadline, *(at for at, _, _ in self._arrivals[:1])]))
        return self.events[-1]


def pdus(events: Sequence[Event]) -> list[bytes | str]:
    """Events without their times: the reply PDU or the error's label."""
    return [event.pdu if isinstance(event, Replied) else event.error.label for event in events]
