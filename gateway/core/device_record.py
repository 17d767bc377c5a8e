"""What the engine keeps of one device, and how replies become snapshots.

The parts (one a planned block) are merged into a new immutable `Snapshot` after each poll. A value is
always decoded from one read, and carries the time at which that read's request went out.
"""

from __future__ import annotations

from dataclasses import replace
from types import MappingProxyType

from gateway.core.health import Breaker
from gateway.core.scheduler import PollList
from gateway.core.site import Device
from gateway.core.snapshot import Block, DeviceState, Snapshot
from gateway.devices.decode import Decoder
from gateway.devices.model import Identification, Space, Value

PartKey = tuple[Space, int, int]


class DeviceRecord:
    """A device, its polls and breaker, and the blocks that were read of it."""

    def __init__(self, device: Device, polls: PollList, now: float) -> None:
        self.device = device
        self.polls = polls
        self.learned_serial = False
        self._decoder = Decoder(device.map, device.decode)
        self._parts: dict[PartKey, tuple[Block, dict[str, Value]]] = {}
        device.snapshot = Snapshot(state_since=now)

    @property
    def breaker(self) -> Breaker:
        """The device's breaker."""
        return self.polls.breaker

    @property
    def state(self) -> DeviceState:
        """The state that the faces see now."""
        return self.device.snapshot.state

    def store(self, block: Block, now: float) -> None:
        """Take in a block that was read by a poll and publish a new snapshot."""
        values = self._decoder.decode(block.space, block.first, block.data)
        self.device.stats.implausible = self._decoder.implausible
        self._parts[(block.space, block.first, block.count)] = (block, values)
        merged: dict[str, Value] = {}
        read_at: dict[str, float] = {}
        for part, part_values in self._parts.values():
            merged.update(part_values)
            read_at.update(dict.fromkeys(part_values, part.read_at))
        self._publish(
            last_reply_at=now,
            blocks=tuple(part for part, _ in self._parts.values()),
            values=MappingProxyType(merged),
            read_at=MappingProxyType(read_at),
        )

    def drop(self, key: PartKey) -> None:
        """Forget a block that is no longer read as one (it was split)."""
        self._parts.pop(key, None)

    def heard(self, now: float) -> None:
        """The device answered something that is not a poll's block."""
        self._publish(last_reply_at=now)

    def identified(self, identification: Identification, now: float) -> None:
        """Read Device Identification was answered."""
        self._publish(last_reply_at=now, identification=identification)

    def numbered(self, serial_number: str, now: float) -> None:
        """The serial number was read."""
        self._publish(last_reply_at=now, serial_number=serial_number)

    def become(self, state: DeviceState, now: float) -> float:
        """Publish a new state; gives the seconds that the old one lasted."""
        lasted_s = now - self.device.snapshot.state_since
        self._publish(state=state, state_since=now)
        return lasted_s

    def _publish(self, **changes: object) -> None:
        old = self.device.snapshot
        self.device.snapshot = replace(old, version=old.version + 1, **changes)  # type: ignore[arg-type]  # names are checked by replace
