"""Reading replies as quickly as a long walk wants it; pysnmp reads the same in the tests of the responder."""

from __future__ import annotations

from gateway.faces.snmp.settings import Oid

INTEGER, OCTETS, NAME, SEQUENCE, RESPONSE = 0x02, 0x04, 0x06, 0x30, 0xA2
END_OF_MIB_VIEW = b"\x82\x00"


def split(data: bytes, at: int = 0) -> tuple[int, int, int]:
    """Tag of the value at an offset, and where its content begins and ends."""
    size = data[at + 1]
    begin = at + 2
    if size & 0x80:
        begin += size & 0x7F
        size = int.from_bytes(data[at + 2 : begin])
    assert begin + size <= len(data)
    return data[at], begin, begin + size


def parts(data: bytes, tag: int) -> list[bytes]:
    """The encoded values in a constructed one of that tag, which is all there is."""
    found, at, end = split(data)  # at: where the first of them begins
    assert (found, end) == (tag, len(data))
    values = []
    while at < end:
        _, _, behind = split(data, at)
        values.append(data[at:behind])
        at = behind
    return values


def number(data: bytes) -> int:
    """An INTEGER."""
    tag, begin, end = split(data)
    assert (tag, end) == (INTEGER, len(data))
    return int.from_bytes(data[begin:end], signed=True)


def oid(data: bytes) -> Oid:
    """An OBJECT IDENTIFIER below 1 or 2.39."""
    tag, begin, end = split(data)
    assert (tag, end) == (NAME, len(data))
    arcs, arc = [], 0
    for octet in data[begin:end]:
        arc = arc << 7 | octet & 0x7F
        if not octet & 0x80:
            arcs.append(arc)
            arc = 0
    return (*divmod(arcs[0], 40), *arcs[1:])


def response(pdu: bytes) -> tuple[int, int, list[tuple[Oid, bytes]]]:
    """Status, index, and the names and encoded values of a Response-PDU."""
    _, status, index, varbinds = parts(pdu, RESPONSE)
    pairs = [parts(each, SEQUENCE) for each in parts(varbinds, SEQUENCE)]
    return number(status), number(index), [(oid(name), value) for name, value in pairs]


def message(data: bytes) -> tuple[int, int, list[tuple[Oid, bytes]]]:
    """The same of a v1 or v2c message."""
    _, _, pdu = parts(data, SEQUENCE)
    return response(pdu)
