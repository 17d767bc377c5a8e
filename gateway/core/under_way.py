"""The transactions of a line that are under way, and what they leave free.

Rule 1: a serial line has one of them, a Modbus TCP upstream as many as its server stands (modbus/tcp.py).
Rule 2: a write is alone with its device: it goes out when nothing of the device is under way, and nothing is asked of
        the device until it has ended. So no read that overlaps with it can bring back the old value as a new one.
Rule 3: so is the question after a missed reply, and whatever is asked of a quarantined device.
Rule 4: a turn that is made again to see what its company was to it (`alone`) has the whole line to itself.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from gateway.core.requests import PollItem, Purpose, Turn, WriteTurn
from gateway.core.site import Device


class Sent(NamedTuple):
    """A turn, and when its request went out."""

    turn: Turn
    sent_at: float


class UnderWay:
    """What was sent and has not ended, by the keys that the wire gave."""

    __slots__ = ("_closed", "_counts", "_sent", "alone")

    def __init__(self) -> None:
        self._sent: dict[int, Sent] = {}
        self._counts: dict[int, int] = {}  # unit id → turns of that device
        self._closed: set[int] = set()  # unit ids of devices that take nothing else meanwhile
        self.alone = False  # the one that is under way must have no company

    def __len__(self) -> int:
        return len(self._sent)

    def __iter__(self) -> Iterator[Sent]:
        return iter(list(self._sent.values()))

    def add(self, key: int, turn: Turn, now: float, *, closed: bool, alone: bool) -> None:
        """A request went out; `closed`: its device takes nothing else until it has ended (rules 2 and 3)."""
        unit = turn.device.unit_id
        self._sent[key] = Sent(turn, now)
        self._counts[unit] = self._counts.get(unit, 0) + 1
        if closed or isinstance(turn, WriteTurn):
            self._closed.add(unit)
        self.alone = alone
        if isinstance(turn, PollItem):
            turn.under_way = True
            if turn.purpose is Purpose.SETTLE:
                self._closed.add(unit)

    def end(self, key: int) -> Sent:
        """It has ended."""
        sent = self._sent.pop(key)
        unit = sent.turn.device.unit_id
        self._counts[unit] -= 1
        if not self._counts[unit]:
            self._closed.discard(unit)
        if not self._sent:
            self.alone = False
        if isinstance(sent.turn, PollItem):
            sent.turn.under_way = False
        return sent

    def clear(self) -> list[Sent]:
        """All have ended."""
        return [self.end(key) for key in list(self._sent)]

    def idle(self, device: Device) -> bool:
        """Whether nothing of the device is under way."""
        return not self._counts.get(device.unit_id)

    def open(self, device: Device) -> bool:
        """Whether the device takes another read."""
        return device.unit_id not in self._closed
