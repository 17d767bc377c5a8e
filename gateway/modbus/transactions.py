"""What a line's state machine tells of its transactions, whatever the line is: RTU on a wire, or Modbus TCP.

A line carries one transaction at a time (rtu.py) or several (tcp.py). Each has a key that is unique among those
under way; its end comes with that key.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

from gateway.errors import RequestError
from gateway.modbus.collector import Echo


class Replied(NamedTuple):
    """The request was answered; `pdu` may be the device's exception."""

    pdu: bytes
    sent_at: float
    received_at: float


@dataclass(frozen=True, slots=True)
class Failed:
    """The request ended without an answer: ReplyTimeout, ReplyCrcError, ReplyMismatch or ConnectionLost.

    `blameless`: the connection or those under way with it may have been the cause, so it says nothing of the device.
    """

    error: RequestError
    sent_at: float
    at: float
    blameless: bool = False


class Ended(NamedTuple):
    """The end of the transaction with that key."""

    key: int
    event: Replied | Failed


class Wire(Protocol):
    """The state machine of a line, as the engine moves it; sans-IO, times are monotonic seconds."""

    @property
    def echo(self) -> Echo:
        """Whether the line gives our requests back."""
        ...

    @property
    def relays(self) -> bool:
        """Whether exceptions 0A and 0B are a gateway's word about a device, and not the device's own."""
        ...

    @property
    def silent(self) -> bool:
        """Whether nobody at all answers, so that a missed reply says nothing of its device."""
        ...

    def ready_at(self, now: float) -> float:
        """The earliest time from `now` on at which the next request may go out; infinite while there is no room."""
        ...

    def send(self, address: int, pdu: bytes, now: float, timeout_s: float) -> tuple[int, bytes]:
        """Start a transaction: its key, and the bytes to write at once. A RequestError changes nothing."""
        ...

    def receive(self, data: bytes, now: float) -> Sequence[Ended]:
        """Take bytes; the transactions that they end, in their order."""
        ...

    def on_timer(self, now: float) -> Sequence[Ended]:
        """Let time pass; the transactions that it ends."""
        ...

    def next_deadline(self) -> float | None:
        """When `on_timer` has something to do; None when only bytes or a request can change anything."""
        ...

    def bytes_due(self) -> int:
        """How many bytes are at least still to come before something can happen; 0 when that is not known."""
        ...

    def quarantine_s(self, now: float) -> float:
        """How long the line must be silent after a failure."""
        ...

    def reset(self, now: float) -> None:
        """The line was opened or closed: forget what was under way. Nothing of it is reported."""
        ...
