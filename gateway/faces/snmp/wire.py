"""What the agent writes, in BER, and the two fields that it reads before it trusts a datagram.

Messages are decoded by pysnmp's own message classes (`responder.py`); nothing of that is repeated here. Replies are
put together from finished pieces instead, because a varbind that is kept as bytes costs nothing to send again and
has an exact length, which GETBULK's byte budget needs. tests/faces/snmp/test_wire.py proves each
encoder against pyasn1's.
"""

from __future__ import annotations

from gateway.faces.snmp.objects import CellValue, Syntax
from gateway.faces.snmp.settings import Oid

TAGS: dict[Syntax, int] = {
    Syntax.INTEGER32: 0x02,
    Syntax.ENUMERATION: 0x02,
    Syntax.TEXT: 0x04,
    Syntax.BITS: 0x04,
    Syntax.OBJECT_IDENTIFIER: 0x06,
    Syntax.COUNTER32: 0x41,
    Syntax.GAUGE32: 0x42,
    Syntax.UNSIGNED32: 0x42,
    Syntax.TIME_TICKS: 0x43,
    Syntax.TIME_STAMP: 0x43,
}
"""RFC 3417 §8 and RFC 2578: the identifier octet of each syntax."""

WRAPPING = frozenset({Syntax.COUNTER32, Syntax.TIME_TICKS, Syntax.TIME_STAMP})

NO_SUCH_OBJECT = b"\x80\x00"
NO_SUCH_INSTANCE = b"\x81\x00"
END_OF_MIB_VIEW = b"\x82\x00"

RESPONSE = 0xA2
VERSION_2C = 1


class NotSnmp(ValueError):
    """The datagram does not begin like an SNMP message with a community."""


def tlv(tag: int, content: bytes) -> bytes:
    """One value with its identifier and definite length."""
    size = len(content)
    if size < 0x80:
        return bytes((tag, size)) + content
    length = size.to_bytes((size.bit_length() + 7) // 8, "big")
    return bytes((tag, 0x80 | len(length))) + length + content


def integer(tag: int, value: int) -> bytes:
    """An integer in the fewest octets, two's complement."""
    return tlv(tag, value.to_bytes((value + (value < 0)).bit_length() // 8 + 1, "big", signed=True))


def object_identifier(oid: Oid) -> bytes:
    """An OID of two arcs or more."""
    content = bytearray()
    for arc in (oid[0] * 40 + oid[1], *oid[2:]):
        piece = [arc & 0x7F]
        rest = arc >> 7
        while rest:
            piece.append(0x80 | rest & 0x7F)
            rest >>= 7
        content += bytes(reversed(piece))
    return tlv(0x06, bytes(content))


def value(syntax: Syntax, cell: CellValue) -> bytes:
    """A cell that has a value."""
    tag = TAGS[syntax]
    if isinstance(cell, int):
        return integer(tag, cell & 0xFFFFFFFF if syntax in WRAPPING else cell)
    if isinstance(cell, bytes):
        return tlv(tag, cell)
    assert cell is not None
    return object_identifier(cell)


def varbind(name: bytes, content: bytes) -> bytes:
    """A VarBind of an encoded name and an encoded value."""
    return tlv(0x30, name + content)


def response(community: bytes, request_id: int, status: int, index: int, varbinds: bytes) -> bytes:
    """A whole SNMPv2c Response message; `varbinds` are encoded VarBinds one after the other."""
    pdu = integer(0x02, request_id) + integer(0x02, status) + integer(0x02, index) + tlv(0x30, varbinds)
    return tlv(0x30, integer(0x02, VERSION_2C) + tlv(0x04, community) + tlv(RESPONSE, pdu))


def peek(data: bytes) -> tuple[int, bytes]:
    """Version and community of a message, without decoding what follows them; raises NotSnmp.

    Access is decided by these two before the rest is touched. The outer length must be that of the datagram.
    """
    if data[:1] != b"\x30":
        raise NotSnmp("no SEQUENCE")
    start, end = _content(data, 0, len(data))
    if end != len(data):
        raise NotSnmp("length is not that of the datagram")
    if data[start : start + 1] != b"\x02":
        raise NotSnmp("no version")
    first, after = _content(data, start, end)
    if not 1 <= after - first <= 4:
        raise NotSnmp("version is no small integer")
    version = int.from_bytes(data[first:after], "big", signed=True)
    if version != VERSION_2C:
        return version, b""
    if data[after : after + 1] != b"\x04":
        raise NotSnmp("no community")
    first, after = _content(data, after, end)
    return version, data[first:after]


def _content(data: bytes, at: int, end: int) -> tuple[int, int]:
    """Where the content of the value at `at` begins and ends; raises NotSnmp when it passes `end`."""
    if at + 2 > end:
        raise NotSnmp("truncated")
    size = data[at + 1]
    start = at + 2
    if size & 0x80:
        octets = size & 0x7F
        if not 1 <= octets <= 4 or start + octets > end:
            raise NotSnmp("unusable length")
        size = int.from_bytes(data[start : start + octets], "big")
        start += octets
    if start + size > end:
        raise NotSnmp("longer than what holds it")
    return start, start + size
