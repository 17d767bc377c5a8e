"""What the engine keeps of one device, and how replies become snapshots.

The values of each block that was read take the place of what was read of its points before, in a new immutable
`Snapshot` after each poll. A value is always decoded from one read, and carries the time at which that read's request
went out. The scaling of a device that tells its own may come from another read; when it turns out to be another one,
everything is decoded anew.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from types import MappingProxyType

from gateway.core.doubt import Doubt
from gateway.core.health import Breaker
from gateway.core.identity import Identity, Kept
from gateway.core.scheduler import PollList
from gateway.core.site import Device
from gateway.core.snapshot import Block, DeviceState, Snapshot, holds
from gateway.devices.codecs import read_words
from gateway.devices.decode import Decoder
from gateway.devices.model import DeviceMap, Identification, Point, Space, Value
from gateway.devices.texts import words_of

HEARD_S = 0.05


def _decoder(device: Device) -> Decoder:
    """By the readings that were chosen; for a model that was found, those of them that it has."""
    if not device.auto:
        return Decoder(device.map, device.decode)
    readings = {point.name: {reading.name for reading in point.readings} for point in device.map.points}
    return Decoder(
        device.map, {name: chosen for name, chosen in device.decode.items() if chosen in readings.get(name, ())}
    )


def _keepers(device_map: DeviceMap) -> tuple[tuple[str, Point], ...]:
    """The growing counters of a model that its memory keeps, and the points that they are kept in."""
    growing = device_map.identity.growing
    return tuple((rule.point, device_map.point(rule.stored)) for rule in growing if rule.stored is not None)


class _Times(Mapping[str, float]):
    """When the points that have a value were read: what `Snapshot.read_at` says, without a dictionary a snapshot."""

    __slots__ = ("_parts", "_texts", "_values")

    def __init__(
        self, values: Mapping[str, Value], texts: Mapping[str, str], parts: tuple[tuple[frozenset[str], float], ...]
    ) -> None:
        """`parts` are the names of the points in each block and the time of the block; no name is in two of them."""
        self._values = values
        self._texts = texts
        self._parts = parts

    def __getitem__(self, name: str) -> float:
        if name in self:
            for names, read_at in self._parts:
                if name in names:
                    return read_at
        raise KeyError(name)

    def __contains__(self, name: object) -> bool:
        return name in self._values or name in self._texts

    def __iter__(self) -> Iterator[str]:
        yield from self._values
        yield from self._texts

    def __len__(self) -> int:
        return len(self._values) + len(self._texts)


class DeviceRecord:
    """A device, its polls and breaker, and the blocks that were read of it."""

    def __init__(self, device: Device, polls: PollList, now: float) -> None:
        self.device = device
        self.polls = polls
        self.breaker: Breaker = polls.breaker
        self.known = device.expected
        self.verified = False  # since the line was opened or the device came back
        self.restarting_until = 0.0  # a restart was commanded: its silence means nothing
        self.asked_at = now  # when the request went out whose end was looked at last
        self.missed_at = -math.inf  # when a missed reply was last counted
        self.rewrites: dict[str, float] = {}  # point that must be written again and again → last written
        self.live_started_at: float | None = None
        self.doubt = Doubt()
        self._decoder = _decoder(device)
        self._keepers = _keepers(device.map)
        self._blocks: list[Block] = []  # no address is in two of them
        self._scaling: dict[str, Value] = {}  # what the device last told of it, since the line was opened
        self._stored: Mapping[str, Kept] = {}  # as of `Identity`
        device.snapshot = Snapshot(state_since=now)

    @property
    def state(self) -> DeviceState:
        """The state that the faces see now."""
        return self.device.snapshot.state

    @property
    def values(self) -> Mapping[str, Value]:
        """The last values, whatever the state."""
        return self.device.snapshot.values

    @property
    def night(self) -> bool:
        """Whether the device says that it sleeps until morning."""
        rule = self.device.map.night
        return rule is not None and self.values.get(rule.point) == rule.value

    def seen(self) -> Identity:
        """What the unit at the other end tells of itself."""
        snapshot = self.device.snapshot
        identification = snapshot.identification
        growing = self.device.map.identity.growing
        counters = {rule.point: self.values[rule.point] for rule in growing if rule.point in self.values}
        return Identity(
            product=None if identification is None else identification.product,
            revision=None if identification is None else identification.revision,
            serial_number=snapshot.serial_number,
            counters=counters,
            at=max((snapshot.read_at[point] for point in counters), default=0.0),
            stored=self._stored,
        )

    def store(self, block: Block, now: float) -> None:
        """Take in a block that was read by a poll and publish a new snapshot."""
        values, texts = self._without(block.space, block.first, block.first + block.count)
        self._blocks.append(block)
        found = self._decode(block, values, texts)
        told = {name: found[name] for name in self._decoder.factors if name in found}
        if told.items() - self._scaling.items():
            self._scaling.update(told)
            values, texts = {}, {}
            for each in self._blocks:
                self._decode(each, values, texts)
        self.device.stats.implausible = self._decoder.implausible
        self._show(values, texts, last_reply_at=now)
        kept = self._kept_in(block)
        if kept:
            self._stored = {**self._stored, **kept}

    def forget(self, space: Space, first: int, end: int) -> None:
        """Drop what was read of these addresses: it was written, or is no longer read as one block."""
        self._show(*self._without(space, first, end))

    def heard(self, now: float) -> None:
        """The device answered something that is not a poll's block; noted to `HEARD_S`, for it makes a new snapshot."""
        before = self.device.snapshot.last_reply_at
        if before is None or now - before >= HEARD_S:
            self._publish(last_reply_at=now)

    def identified(self, identification: Identification, now: float) -> None:
        """Read Device Identification was answered."""
        self._publish(last_reply_at=now, identification=identification)

    def numbered(self, serial_number: str | None, now: float) -> None:
        """The serial number was read; None when there was nothing readable."""
        self._publish(last_reply_at=now, serial_number=serial_number)

    def is_of(self, device_map: DeviceMap) -> None:
        """The device, whose model was to be found, is of this one."""
        self.device.map = device_map
        self.verified = self.verified and not self.known.expects  # it can be asked for its serial number only now
        self._decoder = _decoder(self.device)
        self._keepers = _keepers(device_map)

    def restart(self) -> None:
        """Another unit may stand there now: nothing of the old one is kept but what is known of its identity."""
        self.verified = False
        self.live_started_at = None
        self._blocks = []
        self._scaling.clear()
        self._stored = {}
        self._publish(identification=None, serial_number=None)

    def warn(self, warning: str, *, on: bool) -> bool:
        """Raise or clear a condition that the gateway sees; tells whether that changed anything."""
        warnings = self.device.snapshot.warnings
        changed = (warnings | {warning}) if on else (warnings - {warning})
        if changed == warnings:
            return False
        self._publish(warnings=changed)
        return True

    def become(self, state: DeviceState, now: float) -> float:
        """Publish a new state; gives the seconds that the old one lasted."""
        lasted_s = now - self.device.snapshot.state_since
        self._publish(state=state, state_since=now)
        return lasted_s

    def _kept_in(self, block: Block) -> dict[str, Kept]:
        """The growing counters that the unit's memory keeps in this block, by all readings that there are."""
        found = {}
        for counter, point in self._keepers:
            if holds(block, point):
                at = 2 * (point.address - block.first)
                words = words_of(block.data[at : at + 2 * point.words])
                values = (read_words(reading, words) for reading in point.readings)
                found[counter] = Kept(tuple(value for value in values if value is not None), block.read_at)
        return found

    def _without(self, space: Space, first: int, end: int) -> tuple[dict[str, Value], dict[str, str]]:
        """Drop the blocks that have one of these addresses; gives the values and texts of the others."""
        snapshot = self.device.snapshot
        kept, gone = [], set[str]()
        for block in self._blocks:
            if block.space is space and block.first < end and first < block.first + block.count:
                gone |= self._decoder.names(block.space, block.first, block.count)
            else:
                kept.append(block)
        self._blocks = kept
        if not kept:
            return {}, {}
        return (
            {name: value for name, value in snapshot.values.items() if name not in gone},
            {name: text for name, text in snapshot.texts.items() if name not in gone},
        )

    def _decode(self, block: Block, values: dict[str, Value], texts: dict[str, str]) -> Mapping[str, Value]:
        """Add what a block says; gives its values."""
        decoder = self._decoder
        found = decoder.decode(block.space, block.first, block.data, block.count, self._scaling)
        values.update(found)
        texts.update(decoder.texts(block.space, block.first, block.data))
        return found

    def _show(self, values: dict[str, Value], texts: dict[str, str], **changes: object) -> None:
        names = self._decoder.names
        parts = tuple((names(block.space, block.first, block.count), block.read_at) for block in self._blocks)
        small, few = dict(values), dict(texts)  # a copy takes half the room of what grew
        self._publish(
            blocks=tuple(self._blocks),
            values=MappingProxyType(small),
            texts=MappingProxyType(few),
            read_at=_Times(small, few, parts),
            **changes,
        )

    def _publish(self, **changes: object) -> None:
        old = self.device.snapshot
        self.device.snapshot = replace(old, version=old.version + 1, **changes)  # type: ignore[arg-type]  # names are checked by replace
