"""One harvest of one controller: which blocks to read next, and when it is over. Sans-IO, time as an argument.

Rule 1: a read is of whole blocks, as many as fit (seven of sixteen words); its reply is taken whole or not at all.
Rule 2: a read refused with exception 01, 02 or 03 is halved, and that is remembered (`most`). One that failed is made
        again after a pause, after every second failure with half of the blocks. A single block that is refused, or
        fails `TRIES` times, is passed over: `unread` has it, the harvest is not whole, and a later one tries again.
        When the first `TRIES` blocks are all like this the harvest gives up.
Rule 3: when the newest known day is still in its block, word for word, only what follows it is read, up to the first
        block that is older (`Outcome.NEWER`). Otherwise the whole ring is read (`Outcome.WHOLE`).
Rule 4: a harvest that was interrupted goes on with the blocks it has: one of them is read again first, and when it
        has changed, all are.
Rule 5: a block behind the newest day whose hourmeter cannot be is left to the reading of a whole ring (ring.py);
        `odd` says that one was seen. A wrong hourmeter in the past looks like the end; so whoever misses a day that
        must have been written reads the whole ring (keeper.py).
Rule 6: when the line has no idle time as long as a read, the harvest goes on with reads of half as many blocks, down to
        one; the next harvest tries long ones again.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum

from gateway.devices.log import LOST_HOURS, hourmeter_of, split_blocks
from gateway.devices.model import DeviceMap, LogLayout, Space
from gateway.history.identity import Position
from gateway.modbus.pdu import MAX_REGISTERS, ReadRequest, is_exception

TRIES = 3
LAST_PAUSE_S = 60.0
_REFUSALS = frozenset({0x01, 0x02, 0x03})
_HEADER = 2  # function and byte count


class Outcome(Enum):
    """How a harvest ended."""

    NEWER = "newer"  # `blocks` are the days after the known one
    WHOLE = "whole"  # `blocks` are the ring, but for `unread`
    FAILED = "failed"  # nothing could be read


@dataclass(frozen=True, slots=True)
class BlockRead:
    """Blocks `first` to `first + count - 1`."""

    first: int
    count: int

    def pdu(self, device_map: DeviceMap, layout: LogLayout) -> bytes:
        """The request."""
        address = layout.first + self.first * layout.block_words
        function = device_map.read_function(Space.REGISTERS)
        return ReadRequest(function, address, self.count * layout.block_words).encode()


class Harvest:
    """Ask `next_read`, make the read, tell `replied` or `failed`; until `outcome` is there."""

    def __init__(
        self,
        layout: LogLayout,
        live_hours: int,
        position: Position | None = None,
        staged: Mapping[int, bytes] | None = None,
        most: int | None = None,
    ) -> None:
        """`staged` are blocks of an interrupted reading of the whole ring; `most` blocks go in a read."""
        self._layout = layout
        self._live_hours = live_hours
        self._position = position
        self.most = MAX_REGISTERS // layout.block_words if most is None else most
        self.blocks: dict[int, bytes] = {}
        self.unread: set[int] = set()
        self.odd = False
        self.outcome: Outcome | None = None
        self.ready_at = 0.0  # not before
        self.stage_anew = not staged  # what is staged elsewhere is of no use
        self._fails = 0
        self._shorter = 0
        self._todo: list[int] = []
        self._staged = dict(staged or {})
        self._proof: tuple[int, bytes] | None = None
        if position is not None and 0 <= position.slot < layout.blocks:
            self._hour = position.hourmeter
            self._todo = [(position.slot + n) % layout.blocks for n in range(layout.blocks)]
            self._proof = (position.slot, position.words)
        else:
            self._position = None
            self._read_all(self._staged)

    def next_read(self) -> BlockRead | None:
        """The next read, to be made at `ready_at`; None when it is over."""
        if self.outcome is not None:
            return None
        most = max(1, self.most >> (self._shorter + self._fails // 2))
        first = self._todo[0]
        count = 1
        while count < min(most, len(self._todo)) and self._todo[count] == first + count:
            count += 1
        return BlockRead(first, count)

    def replied(self, read: BlockRead, reply: bytes, now: float) -> dict[int, bytes]:
        """A reply PDU came; gives the blocks of the whole ring that are new, for keeping until it is complete."""
        if is_exception(reply):
            if reply[1] in _REFUSALS:
                self._refused(read)
            else:
                self.failed(now)
            return {}
        data = reply[_HEADER:]
        if len(data) != read.count * 2 * self._layout.block_words:
            self.failed(now)
            return {}
        self._fails = 0
        got = split_blocks(self._layout, data, read.first)
        if self._proof is not None:
            slot, words = self._proof
            if got.get(slot) != words:
                self._read_all({} if self._position is None else self._staged)
                self._position = None
                return {}
            self._proof = None
            if self._position is None:  # the staged blocks are good
                self._todo = [n for n in range(self._layout.blocks) if n not in self.blocks]
                self._over_when_empty()
                return {}
        if self._position is not None:
            self._take_newer(got, self._position)
            return {}
        self.blocks |= got
        self._advance(read.count)
        return got

    def failed(self, now: float) -> None:
        """A read brought nothing usable."""
        self._fails += 1
        self.ready_at = now + min(LAST_PAUSE_S, 2.0**self._fails)
        read = self.next_read()
        if read is not None and read.count == 1 and self._fails >= TRIES + 2 * (self.most.bit_length() - 1):
            self._pass_over()

    def crowded(self) -> None:
        """A read found no idle time that was long enough (rule 6)."""
        self._shorter += 1

    def _refused(self, read: BlockRead) -> None:
        if read.count > 1:
            self.most = max(1, read.count // 2)
        else:
            self._pass_over()

    def _pass_over(self) -> None:
        self._fails = 0
        if self._position is not None:
            self.outcome = Outcome.FAILED  # the next harvest begins with the same block
            return
        if self._proof is not None:
            self._proof = None
            self._read_all({})
            return
        self.unread.add(self._todo[0])
        self._advance(1)
        if not self.blocks and len(self.unread) >= min(TRIES, self._layout.blocks):
            self.outcome = Outcome.FAILED

    def _read_all(self, staged: dict[int, bytes]) -> None:
        self.blocks = dict(staged)
        self.stage_anew = not staged
        if staged:
            last = max(staged)
            self._proof = (last, staged[last])
            self._todo = [last]
        else:
            self._proof = None
            self._todo = list(range(self._layout.blocks))

    def _advance(self, count: int) -> None:
        del self._todo[:count]
        self._over_when_empty()

    def _over_when_empty(self) -> None:
        if not self._todo:
            self.outcome = Outcome.WHOLE

    def _take_newer(self, got: Mapping[int, bytes], position: Position) -> None:
        for slot, block in got.items():
            self._todo.remove(slot)
            if slot == position.slot:
                continue
            hour = hourmeter_of(self._layout, block, position.order)
            if hour is None or hour < self._hour:
                self.outcome = Outcome.NEWER
                return
            if hour > self._live_hours + LOST_HOURS:
                self.odd = True
                self.outcome = Outcome.NEWER
                return
            self._hour = hour
            self.blocks[slot] = block
        if not self._todo:
            self.outcome = Outcome.NEWER
