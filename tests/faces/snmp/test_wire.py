"""Our BER against pyasn1's."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st
from pyasn1.codec.ber import decoder, encoder
from pyasn1.type import univ
from pysnmp.proto import rfc1901, rfc1902

from gateway.faces.snmp import wire
from gateway.faces.snmp.objects import Syntax

OIDS = st.tuples(st.integers(0, 2), st.integers(0, 39), st.lists(st.integers(0, 2**32 - 1), max_size=126)).map(
    lambda parts: (parts[0], parts[1], *parts[2])
)
WORDS = st.integers(0, 2**32 - 1)


@given(st.integers(-(2**31), 2**31 - 1))
def test_integers_are_read_back_and_as_short_as_they_can_be(number: int) -> None:
    encoded = wire.value(Syntax.INTEGER32, number)
    assert decoder.decode(encoded, asn1Spec=rfc1902.Integer32()) == (number, b"")
    # X.690 §8.3.2: the first nine bits are not all alike. pyasn1 takes an octet too many for -128 and the like.
    assert len(encoded) <= len(encoder.encode(rfc1902.Integer32(number)))
    content = encoded[2:]
    assert len(content) == 1 or int.from_bytes(content[:2], "big") >> 7 not in {0, 0b111111111}


@given(WORDS)
def test_unsigned_syntaxes_are_encoded_like_pysnmp_does(number: int) -> None:
    assert wire.value(Syntax.UNSIGNED32, number) == encoder.encode(rfc1902.Unsigned32(number))
    assert wire.value(Syntax.GAUGE32, number) == encoder.encode(rfc1902.Gauge32(number))
    assert wire.value(Syntax.COUNTER32, number) == encoder.encode(rfc1902.Counter32(number))
    assert wire.value(Syntax.TIME_TICKS, number) == encoder.encode(rfc1902.TimeTicks(number))


@given(st.integers(0, 2**40))
def test_counters_and_ticks_wrap_at_32_bits(number: int) -> None:
    assert wire.value(Syntax.COUNTER32, number) == encoder.encode(rfc1902.Counter32(number % 2**32))
    assert wire.value(Syntax.TIME_STAMP, number) == encoder.encode(rfc1902.TimeTicks(number % 2**32))


@given(st.binary(max_size=400))
def test_octet_strings_are_encoded_like_pyasn1_does(octets: bytes) -> None:
    assert wire.value(Syntax.TEXT, octets) == encoder.encode(univ.OctetString(octets))


@given(OIDS)
def test_oids_are_encoded_like_pyasn1_does(oid: tuple[int, ...]) -> None:
    assert wire.object_identifier(oid) == encoder.encode(univ.ObjectIdentifier(oid))


@given(
    st.binary(max_size=300),
    st.integers(-(2**31), 2**31 - 1),
    st.lists(st.tuples(OIDS, WORDS), max_size=20),
)
def test_a_response_is_what_pysnmp_reads_back(
    community: bytes, request_id: int, cells: list[tuple[tuple[int, ...], int]]
) -> None:
    varbinds = b"".join(
        wire.varbind(wire.object_identifier(oid), wire.value(Syntax.GAUGE32, number)) for oid, number in cells
    )

    pdu = wire.tlv(wire.RESPONSE, wire.integer(0x02, request_id) + wire.result(0, 0, varbinds))

    whole = wire.tlv(0x30, wire.integer(0x02, 1) + wire.tlv(0x04, community) + pdu)
    message, rest = decoder.decode(whole, asn1Spec=rfc1901.Message())

    assert rest == b""
    assert bytes(message[1]) == community
    read = message[2].getComponent()
    assert int(read[0]) == request_id
    assert [tuple(pair[0]) for pair in read[3]] == [oid for oid, _ in cells]
    assert [int(pair[1].getComponent().getComponent().getComponent()) for pair in read[3]] == [n for _, n in cells]


@given(st.integers(0, 255), st.integers(0, 0xFFFF))
def test_any_tag_stands_before_any_length(tag: int, size: int) -> None:
    begin = wire.head(tag, size)
    assert begin[0] == tag
    assert begin[1:] == (encoder.encode(univ.OctetString(bytes(size)))[1 : len(begin)])
    assert wire.tlv(tag, bytes(size)) == begin + bytes(size)
