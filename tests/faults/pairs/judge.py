"""What was told of requests, writes and devices, held against what the units remember; a rig says when to look."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cache

from gateway.core.site import Device, Outcome
from gateway.core.snapshot import Block, DeviceState
from gateway.core.write_ledger import Fate
from gateway.devices.model import DeviceMap, Space
from gateway.devices.plan import poll_plan
from gateway.devices.schema import load_map
from gateway.errors import RequestError
from gateway.modbus.pdu import is_exception, parse_read
from tests.faults.pairs.witness import Witness


class Broken(AssertionError):
    """Something that must hold does not."""


@cache
def prostar() -> DeviceMap:
    """The model that is configured."""
    return load_map("prostar-mppt")


@cache
def whole() -> frozenset[tuple[Space, int]]:
    """All that is polled of it."""
    return frozenset((b.space, b.first + k) for b in poll_plan(prostar()) for k in range(b.count))


def is_whole(device: Device) -> bool:
    """Whether all that is polled of a device was read."""
    return whole() <= {(b.space, b.first + k) for b in device.snapshot.blocks for k in range(b.count)}


@dataclass(eq=False, slots=True)
class Asked:
    """A request, as its asker knows it."""

    what: str
    by: float  # when it must have ended
    outcome: Outcome | None = None


@dataclass(eq=False, slots=True)
class Written:
    """A write, and what its asker was told."""

    address: int
    register: int
    value: int
    asked: Asked
    fate: Fate | None = None


class Judge(ABC):
    """Of one rig: `own` are the expected units, `units` all, `devices` those that are configured now, by address."""

    own: dict[int, Witness]
    units: list[Witness]
    upstream: bool

    def __init__(self) -> None:
        self.devices: dict[int, Device] = {}
        self.story: list[str] = []
        self._broken: Broken | None = None
        self._versions: dict[Device, int] = {}
        self._looked_at: set[tuple[Device, float]] = set()
        self._known: set[Device] = set()
        self._judged: dict[tuple[Device, Space, int], Block] = {}
        self._told_at: dict[tuple[int, int], float] = {}  # address, register → when the unit took what was told done

    @property
    @abstractmethod
    def now(self) -> float:
        """The time."""

    def broken(self, what: str) -> Broken:
        """What went wrong, and what had happened; kept, for the engine survives its callers."""
        error = Broken("\n".join((f"at {self.now:.3f}: {what}", *self.story[-40:])))
        self._broken = self._broken or error
        return error

    def _judge_reply(
        self,
        address: int,
        pdu: bytes,
        outcome: Outcome,
        asked: Asked,
        *,
        since: float,
        told: dict[tuple[int, int], float],
    ) -> None:
        if isinstance(outcome, RequestError):
            return
        own = self.own[address]
        if is_exception(outcome):
            relayed = self.upstream and outcome[1] in {0x0A, 0x0B}
            if not relayed and not own.refused(outcome[1], since):
                raise self.broken(f"{asked.what}: an exception that it did not give, {outcome.hex()}")
            return
        read = parse_read(pdu)
        space = own.map.functions[read.function]
        if space is Space.REGISTERS:
            for register in range(read.address, read.address + read.count):
                since = max(since, told.get((address, register), since))
        if not own.gave(space, read.address, read.count, outcome[2:], since):
            raise self.broken(f"{asked.what}: not what it has or had: {outcome.hex()}")

    def _judge_write(self, written: Written) -> None:
        """What its asker was told is what became of it."""
        took = [unit for unit in self.units for _, _, value in unit.told if value == written.value]
        own = self.own[written.address]
        outcome = written.asked.outcome
        what = f"{written.asked.what} was told {outcome!r} ({written.fate}), and "
        if len(took) > 1:
            raise self.broken(f"{what}was made {len(took)} times")
        if took and took[0] is not own:
            raise self.broken(f"{what}another unit took it")
        code = None
        if isinstance(outcome, RequestError):
            code = outcome.exception_code
        elif outcome is not None and is_exception(outcome):
            code = outcome[1]
        if took and (code in {0x01, 0x02, 0x03, 0x06, 0x0A} or written.fate in {Fate.NOT_SENT, Fate.REFUSED}):
            raise self.broken(f"{what}it was made")
        if not took and outcome is not None and (code is None or written.fate is Fate.WRITTEN):
            raise self.broken(f"{what}it was not made")

    def _judge_devices(self) -> None:
        """What the faces show now."""
        for address, device in self.devices.items():
            snapshot = device.snapshot
            if snapshot.version == self._versions.get(device):
                continue
            self._versions[device] = snapshot.version
            if snapshot.state is not DeviceState.ONLINE:
                continue
            own = self.own[address]
            for block in snapshot.blocks:
                self._judge_block(own, block, device)
            if (device, snapshot.state_since) not in self._looked_at:
                self._looked_at.add((device, snapshot.state_since))
                self._judge_values(device)
            if device not in self._known and is_whole(device):
                self._known.add(device)
            if snapshot.serial_number not in {None, own.serial_number}:
                raise self.broken(f"{device.name} is online as {snapshot.serial_number}")

    def _judge_values(self, device: Device) -> None:
        snapshot = device.snapshot
        for name in snapshot.shown():
            held = snapshot.block_of(device.map.point(name))
            if held is None or held.read_at != snapshot.read_at[name]:
                raise self.broken(f"{name} of {device.name} is shown without a block that has it")

    def _judge_block(self, own: Witness, block: Block, device: Device) -> None:
        key = (device, block.space, block.first)
        if self._judged.get(key) is not block:
            if not own.gave(block.space, block.first, block.count, block.data, block.read_at):
                raise self.broken(f"{device.name} shows {block}")
            self._judged[key] = block
        if block.space is Space.REGISTERS and block.read_at < max(
            (
                at
                for (address, r), at in self._told_at.items()
                if address == own.address and block.first <= r < block.first + block.count
            ),
            default=block.read_at,
        ):
            raise self.broken(f"{device.name} shows what was written over: {block}")

    def knows(self, address: int) -> bool:
        """Whether what the unit keeps in its memory was ever read since the line was configured: else none knows it."""
        return self.devices.get(address) in self._known
