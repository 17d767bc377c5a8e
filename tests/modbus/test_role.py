"""F46 at the level of bytes: what is a role, and that anything else is refused and nothing worse."""

from __future__ import annotations

import contextlib

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pyasn1.codec.der import decoder, encoder
from pyasn1.error import PyAsn1Error
from pyasn1.type import char, univ

from gateway.errors import CertificateRefused
from gateway.modbus.role import is_role, parse_role


def utf8(text: str) -> bytes:
    """As an independent encoder writes it."""
    encoded: bytes = encoder.encode(char.UTF8String(text))
    return encoded


def test_r23_no_extension_is_no_role() -> None:
    assert parse_role([]) is None


@pytest.mark.parametrize("role", ["Operator", "a", "Betriebsführung", "roles;do not split", "x" * 64, "é" * 64])
def test_r22_the_whole_string_is_the_role(role: str) -> None:
    assert parse_role([utf8(role)]) == role


@pytest.mark.parametrize(
    "values",
    [
        pytest.param([utf8("a"), utf8("a")], id="R-65: two"),
        pytest.param([encoder.encode(char.PrintableString("Operator"))], id="R-22: PrintableString"),
        pytest.param([encoder.encode(univ.OctetString(b"Operator"))], id="R-22: OctetString"),
        pytest.param([b"Operator"], id="R-22: bare bytes"),
        pytest.param([encoder.encode(univ.SequenceOf().setComponents(char.UTF8String("a")))], id="a list"),
        pytest.param([b""], id="nothing"),
        pytest.param([b"\x0c"], id="a type only"),
        pytest.param([b"\x0c\x00"], id="empty"),
        pytest.param([b"\x0c\x05Oper"], id="too short"),
        pytest.param([b"\x0c\x03Oper"], id="bytes behind it"),
        pytest.param([b"\x0c\x81\x04Oper"], id="a long form where the short one does"),
        pytest.param([b"\x0c\x80Oper\0\0"], id="indefinite length"),
        pytest.param([b"\x0c\x82\x00\x80" + b"x" * 128], id="a length with a leading zero"),
        pytest.param([b"\x0c\x84\xff\xff\xff\xff"], id="4 GiB that are not there"),
        pytest.param([b"\x0c\x02\xff\xfe"], id="not UTF-8"),
        pytest.param([utf8("x" * 65)], id="65 characters"),
        pytest.param([utf8("x" * 10240)], id="10 KiB"),
        pytest.param([utf8("a\nevent=forged")], id="a line break"),
        pytest.param([utf8('a" peer="1.2.3.4')], id="a quote"),
        pytest.param([utf8(" a")], id="a blank in front"),
        pytest.param([utf8("a\0")], id="a NUL"),
    ],
)
def test_f46_anything_else_is_refused(values: list[bytes]) -> None:
    with pytest.raises(CertificateRefused) as refused:
        parse_role(values)
    assert refused.value.reason == "role_malformed"


@given(st.binary(max_size=200) | st.binary(max_size=100).map(lambda tail: b"\x0c" + tail))
def test_any_bytes_are_a_role_or_refused_as_an_independent_decoder_says(der: bytes) -> None:
    role = None
    with contextlib.suppress(CertificateRefused):
        role = parse_role([der])
    if role is not None:
        assert encoder.encode(char.UTF8String(role)) == der
        return
    with contextlib.suppress(PyAsn1Error, UnicodeDecodeError):
        value, rest = decoder.decode(der, asn1Spec=char.UTF8String())
        if not rest and encoder.encode(value) == der:
            assert not is_role(str(value))
