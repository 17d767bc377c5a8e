"""Modbus PDUs: the functions a ProStar serves, their requests and the exact shape of their replies.

Rule 1: a PDU is function code and data, at most 253 bytes, big endian (Application Protocol V1.1b3, §4.1, §4.2).
Rule 2: addresses are PDU addresses, 0 to 65535; a range never wraps past the end (§4.4).
Rule 3: a reply is right only for the request it answers: the same function, a byte count that is exactly what
        the quantity asks for, for writes the same address and value (§6.1 to 6.6), for Read Device
        Identification objects that fill the PDU exactly (§6.21).
Rule 4: an exception reply is two bytes, the function with bit 7 set and a code other than 0 (§7). It answers a
        request of that very function and no other.

tests/modbus/test_pdu.py compares with pymodbus, which by itself takes identification replies whose lengths do not add
up.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum
from functools import lru_cache

from gateway.errors import IllegalDataAddress, IllegalDataValue, IllegalFunction, ReplyMismatch

MAX_PDU = 253
"""Bytes in the longest PDU (§4.1)."""

MAX_BITS = 2000
MAX_REGISTERS = 125

EXCEPTION_BIT = 0x80
_MEI_IDENTIFICATION = 0x0E
IDENTIFICATION_HEADER = 7
"""Bytes before the objects of an identification reply."""

_COIL_VALUES = (0x0000, 0xFF00)
MORE_FOLLOWS = 0xFF
"""In an identification reply: the objects go on in another one."""

_BASIC_STREAM = 1
_INDIVIDUAL_ACCESS = 4

_READ = struct.Struct(">BHH")


class Function(IntEnum):
    """The function codes we serve or send."""

    READ_COILS = 0x01
    READ_DISCRETE_INPUTS = 0x02
    READ_HOLDING_REGISTERS = 0x03
    READ_INPUT_REGISTERS = 0x04
    WRITE_SINGLE_COIL = 0x05
    WRITE_SINGLE_REGISTER = 0x06
    READ_IDENTIFICATION = 0x2B  # encapsulated interface, with MEI type 0x0E only


_BIT_READS = (Function.READ_COILS, Function.READ_DISCRETE_INPUTS)
_REGISTER_READS = (Function.READ_HOLDING_REGISTERS, Function.READ_INPUT_REGISTERS)
_WRITES = (Function.WRITE_SINGLE_COIL, Function.WRITE_SINGLE_REGISTER)


@dataclass(frozen=True, slots=True)
class ReadRequest:
    """A read of `count` coils, inputs or registers from `address`.

    Raises IllegalFunction for other functions than 1 to 4, IllegalDataValue for a count that is 0 or too
    large, IllegalDataAddress for a range past address 65535.
    """

    function: int
    address: int
    count: int

    def __post_init__(self) -> None:
        if self.function in _BIT_READS:
            limit = MAX_BITS
        elif self.function in _REGISTER_READS:
            limit = MAX_REGISTERS
        else:
            raise IllegalFunction(f"function {self.function:#04x} is not a read")
        if not 1 <= self.count <= limit:
            raise IllegalDataValue(f"quantity {self.count} is not in 1..{limit}")
        if not 0 <= self.address <= 0x10000 - self.count:
            raise IllegalDataAddress(f"{self.count} from {self.address:#06x} passes the end of the address space")

    def encode(self) -> bytes:
        """Five bytes: function, address, quantity (§6.1 to 6.4)."""
        return _READ.pack(self.function, self.address, self.count)

    @property
    def reply_size(self) -> int:
        """Bytes of the PDU that answers it."""
        return 2 + ((self.count + 7) // 8 if self.function in _BIT_READS else 2 * self.count)


@lru_cache(maxsize=128)  # a face, the line and the check of the reply soon look at the same request
def parse_read(pdu: bytes) -> ReadRequest:
    """Read a request PDU of functions 1 to 4.

    Raises IllegalFunction for another function, IllegalDataValue for a wrong length or quantity,
    IllegalDataAddress for a range past address 65535.
    """
    if len(pdu) != _READ.size:
        if pdu and pdu[0] not in _BIT_READS + _REGISTER_READS:
            raise IllegalFunction(f"function {pdu[0]:#04x} is not a read")
        raise IllegalDataValue(f"a read request has {_READ.size} bytes, not {len(pdu)}")
    function, address, count = _READ.unpack(pdu)
    return ReadRequest(function, address, count)


def exception_reply(function: int, code: int) -> bytes:
    """The two bytes that refuse a request of `function` (§7)."""
    return bytes((function | EXCEPTION_BIT, code))


def is_exception(pdu: bytes) -> bool:
    """Whether a reply PDU is an exception (bit 7 of the function code)."""
    return bool(pdu) and pdu[0] >= EXCEPTION_BIT


@lru_cache(maxsize=128)  # a request is looked at when it goes out, and when its reply comes
def expected_reply_size(request: bytes) -> int | None:
    """Bytes of the normal reply PDU; None for Read Device Identification, where its content decides.

    Raises IllegalFunction, IllegalDataValue or IllegalDataAddress when `request` is not a whole request of a
    function we know.
    """
    function = request[0] if request else 0
    if function in _WRITES:
        if len(request) != 5:
            raise IllegalDataValue(f"a single write has 5 bytes, not {len(request)}")
        if function == Function.WRITE_SINGLE_COIL and int.from_bytes(request[3:5], "big") not in _COIL_VALUES:
            raise IllegalDataValue("a coil is written with 0x0000 or 0xFF00")
        return 5
    if function == Function.READ_IDENTIFICATION:
        _check_identification_request(request)
        return None
    return parse_read(request).reply_size


def reply_fits(request: bytes, reply: bytes) -> bool:
    """Whether `reply` has the exact shape of a reply to `request` (rules 3 and 4).

    Raises as `expected_reply_size` when the request itself is not one of ours.
    """
    size = expected_reply_size(request)
    if len(reply) == 2 and reply[0] == request[0] | EXCEPTION_BIT:
        return reply[1] != 0
    if not reply or reply[0] != request[0]:
        return False
    if size is None:
        return _identification_fits(request, reply)
    if request[0] in _WRITES:
        return reply == request
    return len(reply) == size and reply[1] == size - 2


@dataclass(frozen=True, slots=True)
class IdentificationReply:
    """One reply of Read Device Identification (§6.21)."""

    objects: dict[int, bytes]  # object id → its bytes
    more_follows: bool
    next_id: int  # the object to ask for when more follows


def read_identification_request(first: int = 0) -> bytes:
    """Ask for the basic identification (vendor, product code, revision) as a stream from object `first` (§6.21)."""
    return bytes((Function.READ_IDENTIFICATION, _MEI_IDENTIFICATION, _BASIC_STREAM, first))


def parse_identification(reply: bytes) -> IdentificationReply:
    """Read the objects of an identification reply; raises ReplyMismatch when its structure is wrong."""
    if not _identification_structure_ok(reply):
        raise ReplyMismatch("identification reply with a wrong structure")
    objects: dict[int, bytes] = {}
    at = IDENTIFICATION_HEADER
    while at < len(reply):
        end = at + 2 + reply[at + 1]
        objects[reply[at]] = bytes(reply[at + 2 : end])
        at = end
    return IdentificationReply(objects, more_follows=reply[4] == MORE_FOLLOWS, next_id=reply[5])


def least_identification_size(reply: bytes | bytearray) -> int:
    """The least size in bytes that an identification reply PDU beginning with `reply` can have.

    It is the exact size as soon as it is not more than `len(reply)`.
    """
    size = IDENTIFICATION_HEADER
    if len(reply) < size:
        return size
    for left in range(reply[6], 0, -1):
        if len(reply) < size + 2:
            return size + 2 * left
        size += 2 + reply[size + 1]
    return size


def _check_identification_request(request: bytes) -> None:
    if len(request) > 1 and request[1] != _MEI_IDENTIFICATION:
        raise IllegalFunction(f"MEI type {request[1]:#04x} is not Read Device Identification")
    if len(request) != 4:
        raise IllegalDataValue(f"an identification request has 4 bytes, not {len(request)}")
    if not 1 <= request[2] <= _INDIVIDUAL_ACCESS:
        raise IllegalDataValue(f"read device id code {request[2]} is not in 1..4")


def _identification_structure_ok(reply: bytes) -> bool:
    if not IDENTIFICATION_HEADER <= len(reply) <= MAX_PDU or least_identification_size(reply) != len(reply):
        return False
    if reply[0] != Function.READ_IDENTIFICATION or reply[1] != _MEI_IDENTIFICATION:
        return False
    if reply[4] not in {0, MORE_FOLLOWS}:
        return False
    ids = set()
    at = IDENTIFICATION_HEADER
    while at < len(reply):
        ids.add(reply[at])
        at += 2 + reply[at + 1]
    return len(ids) == reply[6]


def _identification_fits(request: bytes, reply: bytes) -> bool:
    if not _identification_structure_ok(reply) or reply[2] != request[2]:
        return False
    return request[2] != _INDIVIDUAL_ACCESS or (reply[6] == 1 and reply[IDENTIFICATION_HEADER] == request[3])
