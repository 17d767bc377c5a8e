"""Immutable values of one device with their times.

A snapshot is replaced whole and never changed, so a face that holds one sees one consistent state. Who only wants to
know later whether the device still has it keeps its `mark`: whoever keeps the snapshot keeps all its values.
All times are monotonic seconds. `Block.read_at` is when the request went out: the values are at
most that old, never older than stated.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from types import MappingProxyType

from gateway.devices.model import Identification, Point, Space, Value

IDENTITY_MISMATCH = "identity_mismatch"
UNKNOWN_MODEL = "unknown_model"
NOT_REWRITTEN = "slave_control_not_refreshed"
"""Of `Snapshot.warnings`: another unit answers; a value that must be written again and again was not in time."""


class DeviceState(StrEnum):
    """Quality of everything a device shows (design §7)."""

    UNKNOWN = "unknown"  # not one reply since start
    ONLINE = "online"
    STALE = "stale"  # three misses
    OFFLINE = "offline"  # quarantined, probed with back-off


@dataclass(frozen=True, slots=True)
class Block:
    """One contiguous read: registers as big-endian words, coils packed as in a reply (bit 0 first)."""

    space: Space
    first: int
    count: int
    data: bytes
    read_at: float


def holds(block: Block, point: Point) -> bool:
    """Whether all of the point's words lie in the block."""
    end = block.first + block.count
    return block.space is point.space and block.first <= point.address and point.address + point.words <= end


_NO_VALUES: Mapping[str, Value] = MappingProxyType({})
_NO_TEXTS: Mapping[str, str] = MappingProxyType({})
_NO_TIMES: Mapping[str, float] = MappingProxyType({})


@dataclass(frozen=True, slots=True)
class Snapshot:
    """State and last values of a device.

    `values` and `texts` have only points that have a value (NaN, infinity and absent sensors are left out) and is kept
    while the device is stale so that a `hold` policy is possible; faces use `shown()`.
    """

    version: int = 0
    state: DeviceState = DeviceState.UNKNOWN
    state_since: float = 0.0
    last_reply_at: float | None = None
    blocks: tuple[Block, ...] = ()
    values: Mapping[str, Value] = field(default_factory=lambda: _NO_VALUES)
    texts: Mapping[str, str] = field(default_factory=lambda: _NO_TEXTS)  # the points that are texts
    read_at: Mapping[str, float] = field(default_factory=lambda: _NO_TIMES)  # point name → its block's read_at
    identification: Identification | None = None
    serial_number: str | None = None
    warnings: frozenset[str] = frozenset()  # conditions that the gateway itself sees
    mark: object = field(default_factory=object, init=False, repr=False, compare=False)  # of this snapshot alone

    def shown(self) -> Mapping[str, Value]:
        """Values that a face may show now: all of an online device, none of any other."""
        return self.values if self.state is DeviceState.ONLINE else _NO_VALUES

    def block_of(self, point: Point) -> Block | None:
        """The block that the whole point was last read in, with a value or without; None when it was not read."""
        return next((block for block in self.blocks if holds(block, point)), None)

    def shown_texts(self) -> Mapping[str, str]:
        """As `shown`, of the points that are texts."""
        return self.texts if self.state is DeviceState.ONLINE else _NO_TEXTS

    def age_s(self, point: str, now: float) -> float | None:
        """Age of a point's value in seconds, or None when it was never read."""
        at = self.read_at.get(point)
        return None if at is None else max(0.0, now - at)
