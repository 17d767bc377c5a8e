"""What the agent reads: a strict reader of the requests that pollers send, and pysnmp for every other.

RFC 3417 §8 allows SNMP a small part of BER: definite lengths and primitive strings. Rules:

1. No function looks outside of the octets it is given; whatever is wrong is `NotSnmp`.
2. `plain_request` takes GET, GETNEXT and GETBULK whose values are NULL, and copies rather than converts: the request id
   and the names stay the octets that they came as. It is unsure rather than clever: anything it does not expect is
   `Unusual`.
3. What is unusual is decoded by pysnmp's classes (`odd_request`), which decide whether it is SNMP. Both give a
   `Request`; tests/faces/snmp/test_paths.py proves that they give the same one.
4. pysnmp takes 80 µs a name, so it is given MOST_ODD of them at most, and nothing that is no request by its form.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

from pyasn1.codec.ber import decoder, encoder
from pysnmp.proto import rfc1157, rfc1905

from gateway.faces.snmp import wire
from gateway.faces.snmp.settings import Oid

VERSION_1 = 0
VERSION_2C = 1
VERSION_3 = 3

GET = 0xA0
GET_NEXT = 0xA1
SET = 0xA3
GET_BULK = 0xA5

MAX_ARCS = 128
"""RFC 2578 §3.5: an OID has no more."""

MOST_ODD = 32
"""Names in an unusual request; one with more is told that the reply would be too big (`Request.too_many`)."""

_MAX_ARC = 0xFFFFFFFF
_ZEROS = b"\x02\x01\x00\x02\x01\x00"
_NULL = b"\x05\x00"


class NotSnmp(ValueError):
    """The octets are no SNMP message."""


class Unusual(ValueError):
    """Not what pollers send; may still be SNMP."""


class Request:
    """A PDU of one of the four kinds that an agent answers."""

    __slots__ = ("first", "id_at", "kind", "names", "request_id", "second", "too_many", "varbinds")

    def __init__(
        self, kind: int, request_id: bytes, counts: tuple[int, int], names: list[bytes], varbinds: bytes
    ) -> None:
        self.kind = kind
        self.request_id = request_id  # encoded INTEGER
        self.id_at = 0  # where the octets of the id are in what was read; 0 when it is not known
        self.first, self.second = counts  # non-repeaters and max-repetitions of GETBULK
        self.names = names  # encoded OBJECT IDENTIFIERs
        self.varbinds = varbinds  # as they came, encoded, one after the other
        self.too_many = False  # more names than are read; `names` is empty then


def content(data: bytes, at: int, end: int, tag: int) -> tuple[int, int]:
    """Where the content of the value of this `tag` at `at` begins and ends; NotSnmp when it passes `end`."""
    if at + 2 > end or data[at] != tag:
        raise NotSnmp("truncated, or not the type that belongs here")
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


def integer(data: bytes, at: int, end: int) -> tuple[int, int]:
    """An INTEGER of at most 32 bits, and where it ends."""
    start, stop = content(data, at, end, 0x02)
    if not 1 <= stop - start <= 4:
        raise NotSnmp("no 32-bit integer")
    return int.from_bytes(data[start:stop], "big", signed=True), stop


def version(data: bytes) -> tuple[int, int, int]:
    """Version of a message, where it begins and where it ends; the outer length must be that of the datagram."""
    size = len(data)
    start, end = content(data, 0, size, 0x30)
    if end != size:
        raise NotSnmp("length is not that of the datagram")
    number, after = integer(data, start, end)
    return number, start, after


def community(data: bytes, at: int) -> tuple[bytes, int]:
    """The community at `at`, and where it ends."""
    start, stop = content(data, at, len(data), 0x04)
    return data[start:stop], stop


def oid(name: bytes) -> Oid:
    """The arcs of an encoded OBJECT IDENTIFIER; NotSnmp when it is none that SNMP allows."""
    at, end = content(name, 0, len(name), 0x06)
    if at == end or name[-1] & 0x80:
        raise NotSnmp("no OID")
    arcs: list[int] = []
    arc = 0
    for octet in name[at:end]:
        if arc == 0 and octet == 0x80:
            raise NotSnmp("an arc with leading zeros")
        arc = arc << 7 | octet & 0x7F
        if arc > _MAX_ARC:
            raise NotSnmp("an arc above 32 bits")
        if not octet & 0x80:
            arcs.append(arc)
            arc = 0
    if len(arcs) >= MAX_ARCS:
        raise NotSnmp("too many arcs")
    first = min(arcs[0] // 40, 2)
    return (first, arcs[0] - 40 * first, *arcs[1:])


def plain_request(data: bytes, at: int) -> Request:
    """The PDU that begins at `at` and ends with `data`; Unusual for anything that pollers do not send."""
    end = len(data)
    try:
        kind = data[at]
        if kind not in (GET, GET_NEXT, GET_BULK):
            raise Unusual("kind")
        at = _inside(data, at, end)
        size = data[at + 1]
        if data[at] != 0x02 or not 1 <= size <= 4:
            raise Unusual("request id")
        start, at = at, at + 2 + size
        request_id = data[start:at]
        counts = (0, 0)
        if kind == GET_BULK:
            non_repeaters, at = _count(data, at)
            repetitions, at = _count(data, at)
            counts = (non_repeaters, repetitions)
        elif data[at : at + 6] == _ZEROS:
            at += 6
        else:
            raise Unusual("error status")
        if data[at] != 0x30:
            raise Unusual("no list")
        first = at = _inside(data, at, end)
        names: list[bytes] = []
        while at < end:
            # 30 size 06 length … 05 00
            length = data[at + 3]
            stop = at + 4 + length
            if (
                length >= 0x7C
                or data[at] != 0x30
                or data[at + 1] != length + 4
                or data[at + 2] != 0x06
                or data[stop : stop + 2] != _NULL
            ):
                raise Unusual("varbind")
            names.append(data[at + 2 : stop])
            at = stop + 2
    except IndexError:
        raise Unusual("truncated") from None
    request = Request(kind, request_id, counts, names, data[first:end])
    request.id_at = start + 2
    return request


def id_place(data: bytes, at: int) -> tuple[int, int]:
    """Where the octets of the request id are, and how many, in the PDU at `at`, if there is one; IndexError if not."""
    size = data[at + 1]
    at += 4 if size < 0x80 else size - 0x7C
    return at, data[at - 1]


def message_id_at(data: bytes) -> int:
    """Where the octets of the request id begin in a message with a community as pollers send it; 0 when it is none."""
    try:
        if data[1] < 0x80:
            at = data[6] + 11
        elif data[5] == VERSION_3:
            return 0
        else:
            first = data[1] - 0x7E
            at, _ = id_place(data, first + 5 + data[first + 4])
    except IndexError:
        return 0
    return at if at < len(data) else 0


def _inside(data: bytes, at: int, end: int) -> int:
    """Where the content of the value at `at` begins; Unusual when it does not end at `end`."""
    size = data[at + 1]
    start = at + 2
    if size == 0x81:
        size = data[start]
        start += 1
    elif size == 0x82:
        size = data[start] << 8 | data[start + 1]
        start += 2
    elif size > 0x82:
        raise Unusual("length")
    if start + size != end:
        raise Unusual("length")
    return start


def _count(data: bytes, at: int) -> tuple[int, int]:
    """A small non-negative INTEGER, and where it ends."""
    size = data[at + 1]
    stop = at + 2 + size
    if data[at] != 0x02 or not 1 <= size <= 4 or data[at + 2] & 0x80 or stop > len(data):
        raise Unusual("count")
    return int.from_bytes(data[at + 2 : stop], "big"), stop


_CONSTRUCTED = 0x20

_KINDS: dict[int, dict[type, int]] = {
    VERSION_1: {rfc1157.GetRequestPDU: GET, rfc1157.GetNextRequestPDU: GET_NEXT, rfc1157.SetRequestPDU: SET},
    VERSION_2C: {
        rfc1905.GetRequestPDU: GET,
        rfc1905.GetNextRequestPDU: GET_NEXT,
        rfc1905.GetBulkRequestPDU: GET_BULK,
        rfc1905.SetRequestPDU: SET,
    },
}


_NO_REQUESTS = {VERSION_1: (b"\xa2", b"\xa4"), VERSION_2C: (b"\xa2", b"\xa6", b"\xa7", b"\xa8")}
"""What the other PDUs of a version begin with."""


def odd_request(data: bytes, at: int, spoken: int) -> Request | None:
    """The PDU that begins at `at`, read by pysnmp; None when it is no request.

    `spoken` is the version whose PDUs it may be (those of SNMPv3 are those of 2c). Raises anything at all on
    malformed BER.
    """
    spoken = VERSION_1 if spoken == VERSION_1 else VERSION_2C
    if data[at : at + 1] in _NO_REQUESTS[spoken]:
        return None
    many = _too_many(data, at, _KINDS[spoken].values())
    if many is not None:
        return many
    choice = rfc1157.PDUs() if spoken == VERSION_1 else rfc1905.PDUs()
    found, rest = decoder.decode(data[at:], asn1Spec=choice)
    if rest:
        raise NotSnmp("octets behind the message")
    pdu: Any = found.getComponent()
    kind = _KINDS[spoken].get(type(pdu))
    if kind is None:
        return None
    names: list[bytes] = []
    for pair in pdu[3]:
        arcs = tuple(int(arc) for arc in pair[0])
        if len(arcs) < 2 or len(arcs) > MAX_ARCS or any(arc > _MAX_ARC for arc in arcs):
            raise NotSnmp("not an OID that SNMP allows")
        names.append(wire.object_identifier(arcs))
    varbinds = b"".join(encoder.encode(pair) for pair in pdu[3])
    counts = (int(pdu[1]), int(pdu[2])) if kind == GET_BULK else (0, 0)
    return Request(kind, wire.integer(0x02, int(pdu[0])), counts, names, varbinds)


def _too_many(data: bytes, at: int, kinds: Collection[int]) -> Request | None:
    """The request that begins at `at`, if it has more than MOST_ODD names.

    NotSnmp when it has not the form of one of these kinds: tags and definite lengths, and values that are primitive.
    """
    end = len(data)
    kind = data[at] if at < end else 0
    if kind not in kinds:
        raise NotSnmp("no PDU")
    at, stop = content(data, at, end, kind)
    first, at = content(data, at, stop, 0x02)
    request_id = data[first:at]
    for _ in range(2):
        _, at = content(data, at, stop, 0x02)
    first, at = content(data, at, stop, 0x30)
    if not at == stop == end:
        raise NotSnmp("octets behind the message")
    names, at = 0, first
    while at < end:
        start, at = content(data, at, end, 0x30)
        _, start = content(data, start, at, 0x06)
        if start == at or data[start] & _CONSTRUCTED or content(data, start, at, data[start])[1] != at:
            raise NotSnmp("no varbind")
        names += 1
    if names <= MOST_ODD:
        return None
    number, _ = integer(wire.tlv(0x02, request_id), 0, len(request_id) + 2)
    request = Request(kind, wire.integer(0x02, number), (0, 0), [], data[first:end])
    request.too_many = True
    return request
