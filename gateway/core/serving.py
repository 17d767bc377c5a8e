"""How one device's requests are answered: from memory, refused, or by asking the line.

The order of the checks is that of the Modbus state diagrams (function, quantity, address), then:

Rule 1: a read is answered from memory only while the device is online and only when one block that is
        younger than `max_age_s` holds all of it. Two reads are never joined, so neither a 32-bit pair
        nor a range is ever put together from two moments; of several blocks the youngest is taken.
Rule 2: memory is the polled blocks of the snapshot and the last few ranges that clients had read from the
        line. The age of the latter counts from before they were asked for. They hold only within
        one stretch of being online: after an outage another device may be at the other end.
Rule 3: what memory cannot answer is asked of the line, once, also of a stale device (three misses): its
        blocks are not shown any more, but the answer to the question may be the one that brings it back.
        The line answers 0B itself when it does not.
Rule 4: a quarantined device is refused at once (0B), or 0A when its line is not open; nothing is asked.
Rule 5: a range outside of the map goes to the device, whose own exception is the answer; with
        `strict_map` it is refused (02) without asking. A range past 0xFFFF is refused always.
Rule 6: identification is answered from what was read of the device while it is online, else forwarded.

Times are monotonic seconds.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from gateway.core.identification import identify
from gateway.core.policy import READ_DEVICE_IDENTIFICATION
from gateway.core.site import Device, LineState, Outcome
from gateway.core.snapshot import Block, DeviceState, Snapshot
from gateway.devices.model import Extent, Space
from gateway.devices.unknown import UNKNOWN
from gateway.errors import DeviceOffline, IllegalDataAddress, LineDown
from gateway.modbus.pdu import ReadRequest, is_exception, parse_read

CLIENT_BLOCKS = 8
"""How many ranges read for clients a device keeps; the oldest goes first."""


@dataclass(frozen=True, slots=True)
class FromMemory:
    """A reply PDU that is right while the device's snapshot has this `mark` and the time is before `valid_until`."""

    reply: bytes
    mark: object
    valid_until: float


class Ask(NamedTuple):
    """Ask the line; give this back to `Serving.learn` with what came."""

    pdu: bytes
    read: ReadRequest | None  # None: identification
    asked_at: float


Answer = FromMemory | Ask


class Serving:
    """The requests of one device."""

    def __init__(self, device: Device, *, max_age_s: float, strict_map: bool) -> None:
        self.device = device
        self.map = device.map
        self.functions = device.map.functions  # those of an unknown model are those of every model
        self._known = {space: covered(device.map.extents, space) for space in Space}
        self._client_blocks: deque[Block] = deque(maxlen=CLIENT_BLOCKS)
        self._blocks_of: tuple[DeviceState, float] | None = None  # the stretch of being online they belong to
        self.adjust(max_age_s=max_age_s, strict_map=strict_map)

    def adjust(self, *, max_age_s: float, strict_map: bool) -> None:
        """Go on by other settings; what was read for clients stays, and a write under way forgets its part of it."""
        self._max_age_s = max_age_s
        self._strict_map = strict_map and self.map is not UNKNOWN  # what its ranges are, it knows alone

    def answer(self, pdu: bytes, now: float) -> Answer:
        """Answer a request that the policy allows; raises the RequestError that refuses it."""
        snapshot = self.device.snapshot
        online = snapshot.state is DeviceState.ONLINE
        if pdu[0] == READ_DEVICE_IDENTIFICATION:
            reply = identify(pdu, snapshot.identification if online else None)
            if reply is not None:
                return FromMemory(reply, snapshot.mark, math.inf)
            self._check_reachable(snapshot, now)
            return Ask(pdu, None, now)
        read = parse_read(pdu)
        space = self.functions[read.function]
        if self._strict_map and not any(
            a <= read.address and read.address + read.count <= b for a, b in self._known[space]
        ):
            raise IllegalDataAddress
        if online:
            block = self._youngest(snapshot, space, read.address, read.count)
            if block is not None and now < block.read_at + self._max_age_s:
                reply = read_reply(block, read.function, read.address, read.count)
                return FromMemory(reply, snapshot.mark, block.read_at + self._max_age_s)
        self._check_reachable(snapshot, now)
        return Ask(pdu, read, now)

    def learn(self, ask: Ask, outcome: Outcome) -> None:
        """Keep the reply to a read for those who ask next (rule 2)."""
        read = ask.read
        if read is None or isinstance(outcome, Exception) or is_exception(outcome):
            return
        space = self.functions[read.function]
        if len(outcome) != read.reply_size:
            return
        self._forget_other_stretches(self.device.snapshot)
        for block in tuple(self._client_blocks):
            if block.first == read.address and block.count == read.count and block.space is space:
                if block.read_at >= ask.asked_at:
                    return
                self._client_blocks.remove(block)
        self._client_blocks.append(Block(space, read.address, read.count, outcome[2:], ask.asked_at))

    def forget(self, space: Space, address: int) -> None:
        """A register or coil was, or may have been, written: what was read of it for clients is not known any more."""
        kept = [b for b in self._client_blocks if b.space is not space or not b.first <= address < b.first + b.count]
        self._client_blocks = deque(kept, maxlen=CLIENT_BLOCKS)

    def _youngest(self, snapshot: Snapshot, space: Space, first: int, count: int) -> Block | None:
        self._forget_other_stretches(snapshot)
        best: Block | None = None
        for blocks in (snapshot.blocks, self._client_blocks):
            for block in blocks:
                if (
                    block.space is space
                    and block.first <= first
                    and first + count <= block.first + block.count
                    and (best is None or block.read_at > best.read_at)
                ):
                    best = block
        return best

    def _forget_other_stretches(self, snapshot: Snapshot) -> None:
        stretch = (snapshot.state, snapshot.state_since)
        if stretch != self._blocks_of:
            self._client_blocks.clear()
            self._blocks_of = stretch

    def _check_reachable(self, snapshot: Snapshot, now: float) -> None:
        if snapshot.state is DeviceState.OFFLINE:
            if self.device.line.status(now).state is LineState.DOWN:
                raise LineDown
            raise DeviceOffline


def covered(extents: Sequence[Extent], space: Space) -> tuple[tuple[int, int], ...]:
    """Addresses that the map describes, as ascending, disjoint `(first, past the last)`; neighbours are joined."""
    runs: list[tuple[int, int]] = []
    for first, end in sorted((extent.first, extent.last + 1) for extent in extents if extent.space is space):
        if runs and first <= runs[-1][1]:
            runs[-1] = (runs[-1][0], max(end, runs[-1][1]))
        else:
            runs.append((first, end))
    return tuple(runs)


def read_reply(block: Block, function: int, first: int, count: int) -> bytes:
    """The reply PDU to a read of `count` registers or coils from `first`, all of which `block` must hold."""
    offset = first - block.first
    if block.space is Space.REGISTERS:
        data = block.data[2 * offset : 2 * (offset + count)]
    else:
        bits = int.from_bytes(block.data, "little") >> offset & ((1 << count) - 1)
        data = bits.to_bytes((count + 7) // 8, "little")
    return bytes((function, len(data))) + data
