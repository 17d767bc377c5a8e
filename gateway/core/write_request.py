"""What a write request asks for, as single writes in order.

Rule 1: the device writes one register or coil at a time (functions 05 and 06). A request for several (0F, 10) is the
        same as its single writes in the order of their addresses, and is looked at as a whole before the first.
Rule 2: a request is well formed or nothing of it is done: length, byte count, quantity and coil values are those of
        Application Protocol V1.1b3 §6.5, 6.6, 6.11 and 6.12 (else exception 03), and no range wraps (02).
Rule 3: functions 16 and 17 (mask, read and write) read and write at one moment, which single writes cannot do: 01.
"""

from __future__ import annotations

from dataclasses import dataclass

from gateway.devices.model import DeviceMap, Space
from gateway.errors import IllegalDataAddress, IllegalDataValue, IllegalFunction
from gateway.modbus.pdu import Function

WRITE_MULTIPLE_COILS = 0x0F
WRITE_MULTIPLE_REGISTERS = 0x10
MAX_COILS = 0x07B0
MAX_REGISTERS = 0x7B
_COIL_VALUES = {0x0000: 0, 0xFF00: 1}
_SINGLE = {Space.COILS: Function.WRITE_SINGLE_COIL, Space.REGISTERS: Function.WRITE_SINGLE_REGISTER}
_SINGLE_OF = {
    WRITE_MULTIPLE_COILS: Function.WRITE_SINGLE_COIL,
    WRITE_MULTIPLE_REGISTERS: Function.WRITE_SINGLE_REGISTER,
}


@dataclass(frozen=True, slots=True)
class SingleWrite:
    """One register or coil and what it is to become: a word, or 0 and 1."""

    space: Space
    address: int
    value: int

    def encode(self) -> bytes:
        """The request of function 05 or 06, which is also its answer."""
        value = 0xFF00 * self.value if self.space is Space.COILS else self.value
        return bytes((_SINGLE[self.space],)) + self.address.to_bytes(2) + value.to_bytes(2)


def parse_write(pdu: bytes, device_map: DeviceMap) -> tuple[SingleWrite, ...]:
    """The single writes that a request PDU asks for, in order; at least one.

    Raises IllegalFunction for a function that single writes of this model cannot do, IllegalDataValue for a wrong
    length, quantity, byte count or coil value, IllegalDataAddress for a range past address 65535.
    """
    function = pdu[0]
    single = _SINGLE_OF.get(function, function)
    space = device_map.write_functions.get(single)
    if space is None or single != _SINGLE[space]:
        raise IllegalFunction(f"function {function:#04x} cannot be done by single writes")
    if function == single:
        return (_parse_single(pdu, space),)
    return _parse_several(pdu, space)


def success_reply(pdu: bytes) -> bytes:
    """The reply to a write that was done: what was asked, without the values of several (§6.5, 6.6, 6.11, 6.12)."""
    return pdu[:5]


def _parse_single(pdu: bytes, space: Space) -> SingleWrite:
    if len(pdu) != 5:
        raise IllegalDataValue(f"a single write has 5 bytes, not {len(pdu)}")
    value = int.from_bytes(pdu[3:5])
    if space is Space.COILS:
        if value not in _COIL_VALUES:
            raise IllegalDataValue("a coil is written with 0x0000 or 0xFF00")
        value = _COIL_VALUES[value]
    return SingleWrite(space, int.from_bytes(pdu[1:3]), value)


def _parse_several(pdu: bytes, space: Space) -> tuple[SingleWrite, ...]:
    coils = space is Space.COILS
    first, count = int.from_bytes(pdu[1:3]), int.from_bytes(pdu[3:5])
    size = (count + 7) // 8 if coils else 2 * count
    if len(pdu) < 6 or not 1 <= count <= (MAX_COILS if coils else MAX_REGISTERS):
        raise IllegalDataValue(f"quantity {count} cannot be written at once")
    if pdu[5] != size or len(pdu) != 6 + size:
        raise IllegalDataValue(f"{len(pdu) - 6} bytes for quantity {count}")
    if first + count > 0x10000:
        raise IllegalDataAddress(f"{count} from {first:#06x} passes the end of the address space")
    data = pdu[6:]
    if coils:
        values = [data[at // 8] >> at % 8 & 1 for at in range(count)]
    else:
        values = [int.from_bytes(data[at : at + 2]) for at in range(0, size, 2)]
    return tuple(SingleWrite(space, first + at, value) for at, value in enumerate(values))
