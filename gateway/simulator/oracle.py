"""A controller whose registers say whose they are: the value-integrity oracle of the tests.

Every register of every device holds another value (up to 15 devices of the ProStar's size), so that a word found
anywhere names its device and address. With `sequenced`, the values also change with every answered read, so that
stale, torn and mixed replies show themselves: `sequence_of` finds the read a reply came from, or none.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from gateway.devices.model import DeviceMap, Space
from gateway.simulator.server import Controller, missing

_WORDS = 0x10000
_SPREAD = 0xACB5  # odd, so that multiplying is one-to-one and neighbours look unlike
_STRIDE = 0x9E37  # odd, so that 65536 sequence numbers give as many keys


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
        registers = [extent for extent in device_map.extents if extent.space is Space.REGISTERS]
        self.addresses = tuple(address for extent in registers for address in range(extent.first, extent.last + 1))
        if not 0 <= device < _WORDS // len(self.addresses):
            raise ValueError(f"no room for device {device}: its registers would repeat those of another")
        first = device * len(self.addresses)
        self._slots = {address: first + position for position, address in enumerate(self.addresses)}
        coils = [extent for extent in device_map.extents if extent.space is Space.COILS]
        self.coil_addresses = tuple(address for extent in coils for address in range(extent.first, extent.last + 1))
        self._coils = frozenset(self.coil_addresses)

    def word(self, address: int, sequence: int = 0) -> int:
        """What a register holds in the answer with that number; KeyError when the model has no such register."""
        return (self._slots[address] ^ (sequence * _STRIDE % _WORDS)) * _SPREAD % _WORDS

    def coil(self, address: int) -> int:
        """What a coil holds: 0 or 1, differently distributed in each device."""
        return ((address + 1) * (2 * self.device + 1) * _SPREAD >> 7) & 1

    def sequence_of(self, first: int, words: Sequence[int], oldest: int = 0) -> int | None:
        """Number of the newest answer not before `oldest` that had these words from `first`; None when none had."""
        for sequence in range(self.sequence, oldest - 1, -1):
            if all(self.word(first + offset, sequence) == word for offset, word in enumerate(words)):
                return sequence
        return None

    def identification(self) -> Mapping[int, bytes]:
        """See `Controller.identification`; the revision carries the device number."""
        identity = self.map.identity
        texts = (identity.vendor, identity.product_codes[0], f"v01.00.{self.device:02d}")
        return {number: text.encode("ascii") for number, text in enumerate(texts)}

    def read(self, space: Space, first: int, count: int, now: float) -> list[int]:
        """See `Controller.read`."""
        del now
        wanted = range(first, first + count)
        there = self._coils if space is Space.COILS else self._slots
        for address in wanted:
            if address not in there:
                raise missing(space, address)
        if space is Space.COILS:
            return [self.coil(address) for address in wanted]
        if self._sequenced:
            self.sequence += 1
        return [self.word(address, self.sequence) for address in wanted]

    def write(self, space: Space, address: int, value: int, now: float) -> bool:
        """See `Controller.write`."""
        del value, now
        if address not in (self._coils if space is Space.COILS else self._slots):
            raise missing(space, address)
        return True
