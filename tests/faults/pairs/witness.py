"""A controller that remembers what it answered and was told, so that it can say of anything whether it was so."""

from __future__ import annotations

from dataclasses import dataclass

from gateway.devices.model import DeviceMap, Extent, PollClass, Space
from gateway.devices.texts import encode_text
from gateway.modbus.pdu import exception_reply
from gateway.simulator.memory import Memory
from gateway.simulator.oracle import OracleController

START = 1000.0
FACTORY_VOLTAGE = 0x4A00


@dataclass(frozen=True, slots=True)
class Answer:
    """What was read of it, and when."""

    at: float
    space: Space
    first: int
    count: int
    data: bytes


class Witness(OracleController):
    """An oracle whose counters, serial number and settings are as those of a real unit.

    All other registers and the coils change with each answer. `hours` is what its hourmeter shows at `START`.
    """

    def __init__(self, device_map: DeviceMap, *, device: int, address: int, serial_number: str, hours: float) -> None:
        super().__init__(device_map, device=device, address=address, sequenced=True)
        identity = device_map.identity
        serial: tuple[Extent, ...] = ()
        if identity.serial_first is not None and not device_map.covers(
            Space.REGISTERS, identity.serial_first, identity.serial_first + 1
        ):
            last = identity.serial_first + identity.serial_words - 1
            serial = (Extent("serial", Space.REGISTERS, identity.serial_first, last, PollClass.BACKGROUND, False, ""),)
        self.serial_number = serial_number
        self.told: list[tuple[float, int, int]] = []  # each write that it heard: when, address, value
        self.refusals: list[tuple[float, int]] = []
        self.exception: int | None = None
        self._memory = Memory(device_map, serial)
        self._rules = identity.growing
        self._lost = 0.0  # what the counters lost with the power
        self._totals = {rule.point: hours * rule.per_hour for rule in self._rules}
        self._kept = {rule.stored: self._totals[rule.point] - 3 for rule in self._rules if rule.stored}
        self._own = set[int]()
        for rule in self._rules:
            self._own |= self._addresses(rule.point)
        if identity.serial_first is not None:
            words = encode_text("ascii", serial_number, identity.serial_words, identity.serial_order)
            self._memory.store(Space.REGISTERS, identity.serial_first, *words)
            self._own |= set(range(identity.serial_first, identity.serial_first + identity.serial_words))
        for extent in device_map.extents:
            if extent.poll is PollClass.SETTINGS and extent.space is Space.REGISTERS:
                self._own |= set(range(extent.first, extent.last + 1))
        self.answers: list[Answer] = []
        self.restore()

    def identification(self) -> dict[int, bytes]:
        """See `Controller.identification`; units of one model do not differ in it."""
        return {**super().identification(), 2: b"v01.01.13"}

    def restore(self) -> None:
        """Factory settings."""
        for extent in self.map.extents:
            if extent.poll is PollClass.SETTINGS and extent.space is Space.REGISTERS:
                self._memory.store(Space.REGISTERS, extent.first, *[FACTORY_VOLTAGE] * extent.count)
        for name, value in self._kept.items():
            self._memory.set(name, value)

    def lose_power(self, now: float) -> None:
        """The counters go on from what memory kept, the settings from what the factory set."""
        for rule in self._rules:
            if rule.stored:
                self._totals[rule.point] = self._kept[rule.stored] - rule.per_hour * (now - START) / 3600
        self.restore()

    def handle(self, pdu: bytes, now: float) -> bytes | None:
        """See `Controller.handle`."""
        if self.silent:
            return None
        if self.exception is not None:
            self.refusals.append((now, self.exception))
            return exception_reply(pdu[0], self.exception)
        for rule in self._rules:
            self._memory.set(rule.point, self._totals[rule.point] + rule.per_hour * (now - START) / 3600)
        reply = super().handle(pdu, now)
        if reply is not None and reply[0] & 0x80:
            self.refusals.append((now, reply[1]))
        elif reply is not None and pdu[0] in self.map.functions:
            first, count = int.from_bytes(pdu[1:3], "big"), int.from_bytes(pdu[3:5], "big")
            self.answers.append(Answer(now, self.map.functions[pdu[0]], first, count, reply[2:]))
        return reply

    def read(self, space: Space, first: int, count: int, now: float) -> list[int]:
        """See `Controller.read`."""
        wanted = range(first, first + count)
        if space is Space.REGISTERS and self._own.issuperset(wanted):
            return self._memory.read(space, first, count)
        found = super().read(space, first, count, now)
        if space is Space.REGISTERS:
            for at in self._own.intersection(wanted):
                found[at - first] = self._memory.read(space, at, 1)[0]
        return found

    def write(self, space: Space, address: int, value: int, now: float) -> bool:
        """See `Controller.write`; it keeps what it is told."""
        done = super().write(space, address, value, now)
        if space is Space.REGISTERS and address in self._own:
            self._memory.store(space, address, value)
        self.told.append((now, address, value))
        return done

    def gave(self, space: Space, first: int, count: int, data: bytes, since: float) -> bool:
        """Whether it gave these data from there, not before that moment."""
        for answer in reversed(self.answers):
            if answer.at < since:
                return False
            if answer.space is space and answer.first <= first and first + count <= answer.first + answer.count:
                offset = first - answer.first
                if space is Space.REGISTERS:
                    part = answer.data[2 * offset : 2 * (offset + count)]
                else:
                    bits = int.from_bytes(answer.data, "little") >> offset & ((1 << count) - 1)
                    part = bits.to_bytes((count + 7) // 8, "little")
                if part == data:
                    return True
        return False

    def refused(self, code: int, since: float) -> bool:
        """Whether it answered with that exception, not before that moment."""
        return any(at >= since and code == its for at, its in self.refusals[-64:])

    def _addresses(self, name: str) -> set[int]:
        point = self.map.point(name)
        return set(range(point.address, point.address + point.words))
