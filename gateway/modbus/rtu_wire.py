"""A serial line as the engine moves it: the RTU client, which carries one transaction at a time."""

from __future__ import annotations

from gateway.modbus.collector import Echo
from gateway.modbus.counters import RtuCounters
from gateway.modbus.rtu import RtuClient, Timing
from gateway.modbus.transactions import Ended, Failed, Replied

_KEY = 0


class RtuWire:
    """Satisfies `Wire` for an `RtuClient`."""

    relays = False
    silent = False

    def __init__(self, timing: Timing, counters: RtuCounters, *, quarantine_s: float) -> None:
        self.client = RtuClient(timing, counters, quarantine_s=quarantine_s)
        self.ready_at = self.client.ready_at
        self.next_deadline = self.client.next_deadline
        self.bytes_due = self.client.bytes_due
        self.quarantine_s = self.client.quarantine_s
        self.reset = self.client.reset

    @property
    def echo(self) -> Echo:
        """See `Wire.echo`."""
        return self.client.echo

    def send(self, address: int, pdu: bytes, now: float, timeout_s: float) -> tuple[int, bytes]:
        """See `Wire.send`."""
        return _KEY, self.client.send(address, pdu, now, timeout_s)

    def receive(self, data: bytes, now: float) -> tuple[Ended, ...]:
        """See `Wire.receive`."""
        return _ended(self.client.receive(data, now))

    def on_timer(self, now: float) -> tuple[Ended, ...]:
        """See `Wire.on_timer`."""
        return _ended(self.client.on_timer(now))


def _ended(event: Replied | Failed | None) -> tuple[Ended, ...]:
    return () if event is None else (Ended(_KEY, event),)
