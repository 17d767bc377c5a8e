"""What the agent writes, in BER.

Replies are put together from finished pieces, because a varbind that is kept as bytes costs nothing to send again and
has an exact length, which GETBULK's byte budget needs. tests/faces/snmp/test_wire.py proves each encoder against
pyasn1's. What the agent reads is in reader.py.
"""

from __future__ import annotations

from collections.abc import Sequence

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
REPORT = 0xA8


_USED = (0x02, 0x04, 0x06, 0x30, 0x41, 0x42, 0x43, RESPONSE, REPORT)
_SHORT = {tag: [bytes((tag, size)) for size in range(0x80)] for tag in _USED}
"""Identifier and short length, ready made for what is written often."""


def tlv(tag: int, content: bytes) -> bytes:
    """One value with its identifier and definite length."""
    size = len(content)
    return _SHORT[tag][size] + content if size < 0x80 and tag in _SHORT else head(tag, size) + content


def head(tag: int, size: int) -> bytes:
    """What stands before a content of so many octets."""
    if size < 0x80:
        return _SHORT[tag][size] if tag in _SHORT else bytes((tag, size))
    length = size.to_bytes((size.bit_length() + 7) // 8, "big")
    return bytes((tag, 0x80 | len(length))) + length


def integer(tag: int, value: int) -> bytes:
    """An integer in the fewest octets, two's complement."""
    return tlv(tag, value.to_bytes((value + (value < 0)).bit_length() // 8 + 1, "big", signed=True))


def object_identifier(oid: Oid) -> bytes:
    """An OID of two arcs or more."""
    return tlv(0x06, arcs((oid[0] * 40 + oid[1], *oid[2:])))


def arcs(numbers: Oid) -> bytes:
    """The octets of arcs within an OID, the first two of which are one number (X.690 §8.19.4)."""
    content = bytearray()
    for arc in numbers:
        piece = [arc & 0x7F]
        rest = arc >> 7
        while rest:
            piece.append(0x80 | rest & 0x7F)
            rest >>= 7
        content += bytes(reversed(piece))
    return bytes(content)


def value(syntax: Syntax, cell: CellValue) -> bytes:
    """A cell that has a value."""
    return tagged(TAGS[syntax], cell, wraps=syntax in WRAPPING)


def tagged(tag: int, cell: CellValue, *, wraps: bool) -> bytes:
    """A cell that has a value, of a syntax with this identifier octet."""
    if isinstance(cell, int):
        return integer(tag, cell & 0xFFFFFFFF if wraps else cell)
    if isinstance(cell, bytes):
        return tlv(tag, cell)
    assert cell is not None
    return object_identifier(cell)


def varbind(name: bytes, content: bytes) -> bytes:
    """A VarBind of an encoded name and an encoded value."""
    return tlv(0x30, name + content)


def cell(name: bytes, content: bytes) -> bytes:
    """A VarBind of the octets of a name and an encoded value: the same as `varbind(tlv(0x06, name), content)`."""
    size = len(name)
    whole = size + len(content) + 2
    if whole >= 0x80:
        return varbind(tlv(0x06, name), content)
    return CELLS[whole] + _NAMES[size] + name + content


CELLS: Sequence[bytes] = _SHORT[0x30]
"""What stands before name and value of a cell, by their octets, up to 127."""

_NAMES = _SHORT[0x06]


def counter(oid: Oid, count: int) -> bytes:
    """A VarBind of a Counter32."""
    return varbind(object_identifier(oid), integer(0x41, count & 0xFFFFFFFF))


def result(status: int, index: int, varbinds: bytes) -> bytes:
    """What follows the request id in a Response; `varbinds` are encoded VarBinds one after the other."""
    if status == 0:
        return _NO_ERROR + tlv(0x30, varbinds)
    return integer(0x02, status) + integer(0x02, index) + tlv(0x30, varbinds)


_NO_ERROR = b"\x02\x01\x00\x02\x01\x00"
