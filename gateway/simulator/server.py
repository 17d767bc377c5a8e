"""The protocol side of a controller: which PDU gets which answer, whatever its registers hold.

Order of the checks (Application Protocol V1.1b3 §7.1-7.x): function known, else 01; quantity, length and
written value right, else 03; address there, else 02; then the request is executed. The device knows
functions 01-06 as its map says and 2B/0E with the basic category as a stream; nothing else.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping

from gateway.devices.model import DeviceMap, Space
from gateway.errors import IllegalDataAddress, IllegalDataValue, IllegalFunction, RequestError
from gateway.modbus.pdu import exception_reply, parse_read

_IDENTIFY = 0x2B
_MEI_DEVICE_IDENTIFICATION = 0x0E
_BASIC_STREAM = 0x01
_COIL_VALUES = {0x0000: False, 0xFF00: True}
_WRITE_SIZE = 5


class Controller(ABC):
    """A Modbus server on a line; subclasses say what it holds.

    `silent` switches the answers off, as if the unit had lost its power; `writes` keeps what it was asked to write.
    """

    def __init__(self, device_map: DeviceMap, address: int, turnaround_s: float) -> None:
        self.map = device_map
        self.address = address
        self.turnaround_s = turnaround_s
        self.silent = False
        self.requests = 0
        self.writes: list[tuple[Space, int, int]] = []

    def handle(self, pdu: bytes, now: float) -> bytes | None:
        """The reply PDU to a request PDU that ended at `now`; None when the unit does not answer."""
        if self.silent or not pdu or not self.hears(now):
            return None
        self.requests += 1
        try:
            return self._execute(pdu, now)
        except RequestError as error:
            return exception_reply(pdu[0], error.exception_code)

    def hears(self, now: float) -> bool:
        """Whether the unit's firmware is running at `now`; it is not while it reboots."""
        del now
        return True

    @abstractmethod
    def identification(self) -> Mapping[int, bytes]:
        """The objects of Read Device Identification, by object id."""

    @abstractmethod
    def read(self, space: Space, first: int, count: int, now: float) -> list[int]:
        """Words, or coils as 0 and 1; IllegalDataAddress when one of them is not there."""

    @abstractmethod
    def write(self, space: Space, address: int, value: int, now: float) -> bool:
        """Execute one write (coils: 0 or 1); False when the unit does not answer it."""

    def _execute(self, pdu: bytes, now: float) -> bytes | None:
        function = pdu[0]
        if function in self.map.functions:
            return self._read(pdu, self.map.functions[function], now)
        if function in self.map.write_functions:
            return self._write(pdu, self.map.write_functions[function], now)
        if function == _IDENTIFY and len(pdu) > 1 and pdu[1] == _MEI_DEVICE_IDENTIFICATION:
            return self._identify(pdu)
        raise IllegalFunction(f"function {function:#04x}")

    def _read(self, pdu: bytes, space: Space, now: float) -> bytes:
        request = parse_read(pdu)
        values = self.read(space, request.address, request.count, now)
        if space is Space.COILS:
            packed = sum(value << position for position, value in enumerate(values))
            data = packed.to_bytes((len(values) + 7) // 8, "little")
        else:
            data = b"".join(value.to_bytes(2, "big") for value in values)
        return bytes([pdu[0], len(data)]) + data

    def _write(self, pdu: bytes, space: Space, now: float) -> bytes | None:
        if len(pdu) != _WRITE_SIZE:
            raise IllegalDataValue("a single write has five bytes")
        address, value = int.from_bytes(pdu[1:3], "big"), int.from_bytes(pdu[3:5], "big")
        if space is Space.COILS:
            if value not in _COIL_VALUES:
                raise IllegalDataValue("a coil is written as 0x0000 or 0xFF00")
            value = int(_COIL_VALUES[value])
        answered = self.write(space, address, value, now)
        self.writes.append((space, address, value))
        return pdu if answered else None

    def _identify(self, pdu: bytes) -> bytes:
        """Application Protocol V1.1b3 §6.21: an unknown first object restarts the stream at object 0."""
        if len(pdu) != 4 or pdu[2] != _BASIC_STREAM:
            raise IllegalDataValue("basic identification as a stream only")
        objects = self.identification()
        first = pdu[3] if pdu[3] in objects else 0
        listed = [(number, text) for number, text in sorted(objects.items()) if number >= first]
        body = b"".join(bytes([number, len(text)]) + text for number, text in listed)
        more_follows, next_object = 0x00, 0x00
        head = [_IDENTIFY, _MEI_DEVICE_IDENTIFICATION, _BASIC_STREAM, _BASIC_STREAM, more_follows, next_object]
        return bytes([*head, len(listed)]) + body


def missing(space: Space, address: int) -> IllegalDataAddress:
    """The error of an address that the model does not have."""
    return IllegalDataAddress(f"no {space} {address:#06x}")
