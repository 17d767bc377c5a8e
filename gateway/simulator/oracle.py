"""A controller whose registers say whose they are: the value-integrity oracle of the tests.

Every register of every device holds another value (up to 15 devices of the ProStar's size), so that a word found
anywhere names its device and address. With `sequenced`, values and coils also change with every answered read, so
that stale, torn and mixed replies show themselves, and the controller says of any data what is wrong with it:

    foreign  it never gave these words (or bits) from there: another device's, another address's, or made up
    torn     all words are its own, but of several answers
    late     one answer of its own, which it gave before the data was asked for
    stale    the same, when data from memory was allowed, but not that old

No test needs an expectation of its own. A single register or a few coils can fit another answer by chance (of 65536
numbers at most `REMEMBERED` are believed, and only from their own range); from two registers on it does not happen.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

from gateway.devices.agreement import all_maps
from gateway.devices.codecs import read_words
from gateway.devices.model import DeviceMap, Point, Reading, Space, Value
from gateway.errors import RequestError
from gateway.modbus.pdu import exception_reply, parse_read
from gateway.simulator.server import Controller, missing

REMEMBERED = 2048
"""How many answers back a controller knows its own."""

_WORDS = 0x10000
_SPREAD = 0xACB5  # odd, so that multiplying is one-to-one and neighbours look unlike
_STRIDE = 0x9E37  # odd, so that 65536 sequence numbers give as many keys
_UNSPREAD = pow(_SPREAD, -1, _WORDS)
_UNSTRIDE = pow(_STRIDE, -1, _WORDS)


def _registers(device_map: DeviceMap) -> int:
    return sum(extent.count for extent in device_map.extents if extent.space is Space.REGISTERS)


class Verdict(StrEnum):
    """What data is to the one who asked for it."""

    RIGHT = "right"
    FOREIGN = "foreign"
    TORN = "torn"
    LATE = "late"
    STALE = "stale"


@dataclass(frozen=True, slots=True)
class Sample:
    """One answered read: the controller looked at these cells at that time."""

    number: int
    space: Space
    first: int
    count: int
    at: float

    def covers(self, space: Space, first: int, count: int) -> bool:
        """Whether it holds the range."""
        return self.space is space and self.first <= first and first + count <= self.first + self.count

    def touches(self, space: Space, first: int, count: int) -> bool:
        """Whether it holds a part of the range."""
        return self.space is space and self.first < first + count and first < self.first + self.count


class OracleController(Controller):
    """Device number `device` (0 first) with the extents of the map; it confirms writes, keeps none, and notes them."""

    def __init__(
        self,
        device_map: DeviceMap,
        *,
        device: int = 0,
        address: int = 1,
        turnaround_s: float = 0.015,
        sequenced: bool = False,
    ) -> None:
        super().__init__(device_map, address, turnaround_s)
        self.device = device
        self.sequence = 0
        self._sequenced = sequenced
        self._samples: deque[Sample] = deque(maxlen=REMEMBERED)
        self._numbered: dict[int, Sample] = {}  # number modulo 65536 → sample
        registers = [extent for extent in device_map.extents if extent.space is Space.REGISTERS]
        self.addresses = tuple(address for extent in registers for address in range(extent.first, extent.last + 1))
        # As much room for each as the largest model takes, so that models can be mixed.
        room = max(len(self.addresses), *(_registers(each) for each in all_maps()))
        if not 0 <= device < _WORDS // room:
            raise ValueError(f"no room for device {device}: its registers would repeat those of another")
        first = device * room
        self._slots = {address: first + position for position, address in enumerate(self.addresses)}
        coils = [extent for extent in device_map.extents if extent.space is Space.COILS]
        self.coil_addresses = tuple(address for extent in coils for address in range(extent.first, extent.last + 1))
        self._coils = frozenset(self.coil_addresses)

    def word(self, address: int, sequence: int = 0) -> int:
        """What a register holds in the answer with that number; KeyError when the model has no such register."""
        return (self._slots[address] ^ (sequence * _STRIDE % _WORDS)) * _SPREAD % _WORDS

    def coil(self, address: int, sequence: int = 0) -> int:
        """What a coil holds in the answer with that number: 0 or 1, differently distributed in each device."""
        mixed = (address + 1) * _SPREAD & sequence * _STRIDE % _WORDS  # its parity: another pattern for each number
        return (((address + 1) * (2 * self.device + 1) * _SPREAD >> 7) + mixed.bit_count()) & 1

    def sequence_of(self, first: int, words: Sequence[int], oldest: int = 0) -> int | None:
        """Number of the newest answer not before `oldest` that had these words from `first`; None when none had."""
        for sequence in range(self.sequence, oldest - 1, -1):
            if all(self.word(first + offset, sequence) == word for offset, word in enumerate(words)):
                return sequence
        return None

    def identification(self) -> Mapping[int, bytes]:
        """See `Controller.identification`; the revision carries the device number."""
        identity = self.map.identity
        whole = (code for code in identity.product_codes if all(self.map.on_product(e, code) for e in self.map.extents))
        texts = (identity.vendor, next(whole), f"v01.00.{self.device:02d}")
        return {number: text.encode("ascii") for number, text in enumerate(texts)}

    def read(self, space: Space, first: int, count: int, now: float) -> list[int]:
        """See `Controller.read`."""
        wanted = range(first, first + count)
        there = self._coils if space is Space.COILS else self._slots
        for address in wanted:
            if address not in there:
                raise missing(space, address)
        if self._sequenced:
            self._remember(space, first, count, now)
        cell = self.coil if space is Space.COILS else self.word
        return [cell(address, self.sequence) for address in wanted]

    def judge(
        self, space: Space, first: int, count: int, data: bytes, *, asked_at: float, max_age_s: float | None = None
    ) -> Verdict:
        """What `data` is as an answer for that range: words big endian, coils packed as in a reply.

        It must have been sampled at `asked_at` or later; where it may come from memory, at most `max_age_s` before.
        """
        size = (count + 7) // 8 if space is Space.COILS else 2 * count
        if len(data) != size:
            return Verdict.FOREIGN
        found = self._bits(first, count, data) if space is Space.COILS else self._words(first, count, data)
        if isinstance(found, Verdict):
            return found
        if found.at >= asked_at - (max_age_s or 0.0):
            return Verdict.RIGHT
        return Verdict.LATE if max_age_s is None else Verdict.STALE

    def judge_reply(self, request: bytes, reply: bytes, *, asked_at: float, max_age_s: float | None = None) -> Verdict:
        """What a reply PDU is as the answer to a request PDU; exceptions must be those that the unit itself gives."""
        try:
            if request[0] in self.map.write_functions:
                return Verdict.RIGHT if reply == request else Verdict.FOREIGN
            if request[0] not in self.map.functions:
                return Verdict.RIGHT if reply == self._identify(request) else Verdict.FOREIGN
            read = parse_read(request)
            space = self.map.functions[read.function]
            there = self._coils if space is Space.COILS else self._slots
            for address in range(read.address, read.address + read.count):
                if address not in there:
                    raise missing(space, address)
        except RequestError as error:
            refusal = exception_reply(request[0], error.exception_code)
            return Verdict.RIGHT if reply == refusal else Verdict.FOREIGN
        if reply[:2] != bytes((read.function, read.reply_size - 2)):
            return Verdict.FOREIGN
        return self.judge(space, read.address, read.count, reply[2:], asked_at=asked_at, max_age_s=max_age_s)

    def judge_value(self, point: Point, value: Value, *, read_at: float, reading: str | None = None) -> Verdict:
        """What a decoded value is that claims to have been read at `read_at` or later."""
        form = point.reading(reading)
        verdict = Verdict.FOREIGN
        for sample in reversed(self._samples):
            if not sample.covers(point.space, point.address, point.words):
                continue
            if point.space is Space.COILS:
                held: Value | None = self.coil(point.address, sample.number)
            else:
                held = read_words(form, self._words_of(point, sample), self._scaling(form, sample))
            if held == value:
                if sample.at >= read_at:
                    return Verdict.RIGHT
                verdict = Verdict.LATE
        return verdict

    def _words_of(self, point: Point, sample: Sample) -> list[int]:
        return [self.word(point.address + k, sample.number) for k in range(point.words)]

    def _scaling(self, form: Reading, sample: Sample) -> dict[str, Value]:
        """What the same answer says of the scaling; a point scaled by another answer is not judged."""
        points = [self.map.point(name) for name in form.factors]
        found = (
            (point.name, read_words(point.reading(), self._words_of(point, sample)))
            for point in points
            if sample.covers(point.space, point.address, point.words)
        )
        return {name: value for name, value in found if value is not None}

    def _remember(self, space: Space, first: int, count: int, now: float) -> None:
        self.sequence += 1
        if len(self._samples) == REMEMBERED:
            del self._numbered[self._samples[0].number % _WORDS]
        sample = Sample(self.sequence, space, first, count, now)
        self._samples.append(sample)
        self._numbered[self.sequence % _WORDS] = sample

    def _number_in(self, address: int, word: int) -> int:
        """The number (modulo 65536) of the answer in which a register held a word; -1 for no register."""
        slot = self._slots.get(address)
        return -1 if slot is None else ((slot ^ (word * _UNSPREAD % _WORDS)) * _UNSTRIDE) % _WORDS

    def _words(self, first: int, count: int, data: bytes) -> Sample | Verdict:
        """The answer that gave these registers."""
        numbers = {self._number_in(first + k, int.from_bytes(data[2 * k : 2 * k + 2], "big")) for k in range(count)}
        samples: list[Sample] = []
        for number in numbers:
            sample = self._numbered.get(number)
            if sample is None or not sample.touches(Space.REGISTERS, first, count):
                return Verdict.FOREIGN
            samples.append(sample)
        if len(samples) > 1:
            return Verdict.TORN
        return samples[0] if samples[0].covers(Space.REGISTERS, first, count) else Verdict.FOREIGN

    def _bits(self, first: int, count: int, data: bytes) -> Sample | Verdict:
        """The newest answer that gave these coils."""
        for sample in reversed(self._samples):
            if sample.covers(Space.COILS, first, count) and all(
                data[k >> 3] >> (k & 7) & 1 == self.coil(first + k, sample.number) for k in range(count)
            ):
                return sample
        return Verdict.FOREIGN

    def write(self, space: Space, address: int, value: int, now: float) -> bool:
        """See `Controller.write`."""
        del value, now
        if address not in (self._coils if space is Space.COILS else self._slots):
            raise missing(space, address)
        return True
