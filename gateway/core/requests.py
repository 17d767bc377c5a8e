"""What waits for a line: reads and writes with those who asked for them.

Rule 1: every asker is told once how its request ended, or has left; nobody is told after leaving. What came of a
        request that was on the wire by then goes where the asker said when it left.
Rule 2: identical reads of one device are one `ClientRead` with several waiters; a read whose last waiter left is
        not wanted any more and is not made.
Rule 3: a write has one waiter and is made once.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import IntEnum, StrEnum
from typing import NamedTuple

from gateway.core.site import Device, Outcome
from gateway.devices.model import Space
from gateway.devices.plan import PlannedBlock
from gateway.modbus.pdu import ReadRequest


class Lane(IntEnum):
    """Precedence on a line; the lower number goes first."""

    SLAVE_CONTROL = 0  # a value that the controller needs again and again, or it faults
    WRITE = 1
    CLIENT = 2
    POLL = 3
    BACKGROUND = 4  # the daily log


class Purpose(StrEnum):
    """What line time is spent on."""

    SLAVE_CONTROL = "slave_control"
    WRITE = "write"
    CLIENT = "client"
    POLL = "poll"
    IDENTIFY = "identify"
    SERIAL_NUMBER = "serial_number"
    SETTLE = "settle"  # the small question after a missed reply (doubt.py)
    BACKGROUND = "background"


class Waiter:
    """One asker; the `Ticket` it holds."""

    __slots__ = ("_done", "_keep", "asked_at", "client")

    def __init__(self, done: Callable[[Outcome], None], client: str, asked_at: float) -> None:
        self._done: Callable[[Outcome], None] | None = done
        self._keep: Callable[[Outcome], None] | None = None
        self.client = client
        self.asked_at = asked_at

    @property
    def left(self) -> bool:
        """Whether the asker is gone or has been told."""
        return self._done is None

    def cancel(self, keep: Callable[[Outcome], None] | None = None) -> None:
        """See `core.site.Ticket`."""
        if self._done is not None:
            self._done, self._keep = None, keep

    def finish(self, outcome: Outcome) -> None:
        """Tell the asker, once; what it left behind when it left."""
        done, self._done, self._keep = self._done or self._keep, None, None
        if done is not None:
            done(outcome)


@dataclass(slots=True, eq=False)
class ClientRead:
    """A read that clients (or the history) wait for. `span` is None for identification."""

    device: Device
    pdu: bytes
    lane: Lane
    span: Span | None
    queued_at: float
    attempts: int = 0
    alone: bool = False  # the device refused it together with others: never joined again
    put_off: bool = False  # the device was busy (exception 06) once
    started: bool = False
    waiters: list[Waiter] = field(default_factory=list)

    @property
    def wanted(self) -> bool:
        """Whether anybody still waits."""
        for waiter in self.waiters:  # noqa: SIM110  # asked for each waiting read at each turn; any() takes thrice as long
            if not waiter.left:
                return True
        return False

    def clients(self) -> list[str]:
        """Who still waits, each once."""
        return list(dict.fromkeys(waiter.client for waiter in self.waiters if not waiter.left))


class Span(NamedTuple):
    """Addresses `first` to `first + count - 1` of one space, and the function that asked for them."""

    space: Space
    function: int
    first: int
    count: int  # type: ignore[assignment]  # it hides tuple.count, which nobody calls

    @classmethod
    def of(cls, device: Device, request: ReadRequest) -> Span:
        """The span of a read of this device."""
        return cls(device.map.functions[request.function], request.function, request.address, request.count)

    @property
    def end(self) -> int:
        """One past the last address."""
        return self.first + self.count


@dataclass(slots=True, eq=False)
class ReadTurn:
    """One transaction for one read, or for several that were joined (coalescing.py)."""

    device: Device
    lane: Lane
    pdu: bytes
    span: Span | None
    reads: tuple[ClientRead, ...]
    again: bool = False  # it ended through no fault of its own and is made once more

    @property
    def purpose(self) -> Purpose:
        """What its line time is booked under."""
        return Purpose.BACKGROUND if self.lane is Lane.BACKGROUND else Purpose.CLIENT


@dataclass(slots=True, eq=False)
class WriteTurn:
    """A single write (functions 05 and 06)."""

    device: Device
    pdu: bytes
    lane: Lane
    queued_at: float
    waiter: Waiter

    @property
    def purpose(self) -> Purpose:
        """What its line time is booked under."""
        return Purpose.SLAVE_CONTROL if self.lane is Lane.SLAVE_CONTROL else Purpose.WRITE


@dataclass(slots=True, eq=False)
class PollItem:
    """One recurring (or one-time) read of a device."""

    device: Device
    purpose: Purpose
    pdu: bytes
    block: PlannedBlock | None
    period_s: float | None  # None: done once, then dropped
    due: float
    misses: int = 0  # attempts in a row that gave no data
    fresh: bool = False  # whether it gave data since the line was opened or the device came back
    early_at: float = -math.inf  # when it was last brought forward
    under_way: bool = False
    again: bool = False  # as of `ReadTurn`
    refused: bool = False  # the device says that it has no such thing: asked again in a while

    @property
    def optional(self) -> bool:
        """Whether a device that does not answer this is no worse for it."""
        return self.purpose is Purpose.SERIAL_NUMBER

    def restart(self, now: float) -> None:
        """Due at once, and nothing is known: another unit may stand there now."""
        self.due = now
        self.misses = 0
        self.fresh = False


Turn = ReadTurn | WriteTurn | PollItem
