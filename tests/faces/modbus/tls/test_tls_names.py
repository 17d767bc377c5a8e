"""Names of certificates, from the bytes of the extension on."""

from __future__ import annotations

from ipaddress import ip_address

import pytest
from cryptography import x509
from cryptography.x509.oid import ExtensionOID
from hypothesis import given
from hypothesis import strategies as st

from gateway.faces.modbus.tls_names import Names, names_of, wanted_names
from tests.faces.modbus.tls.conftest import ServeTls
from tests.faces.modbus.tls.site import Pki
from tests.faults.tls.test_f45_certificates import is_refused

LABELS = st.text("abcxyzABCXYZ0189_-", min_size=1, max_size=8)
TEXTS = st.one_of(st.text(max_size=20), st.lists(LABELS, max_size=4).map(".".join))


@pytest.mark.peer
@pytest.mark.parametrize(
    "der",
    [
        b"\x30\x07\x87\x05\x7f\0\0\0\1",  # an address of five bytes
        b"\x30\x04\x82\x02\xff\xfe",  # a name that is no ASCII
        b"\x30\x04\xa3\x02\x05\x00",  # an X.400 address
    ],
)
async def test_a_malformed_extension_is_refused_even_where_no_name_is_wanted(
    serve_tls: ServeTls, pki: Pki, der: bytes
) -> None:
    site = await serve_tls()
    oid = ExtensionOID.SUBJECT_ALTERNATIVE_NAME
    pki.issue("odd", names=(), extensions=[x509.UnrecognizedExtension(oid, der)])
    await is_refused(site, "odd")
    assert site.stats.refused in ({"certificate_unreadable": 1}, {"certificate_invalid": 1})  # by us, or by OpenSSL


@pytest.mark.peer
def test_a_network_is_no_address_of_a_client(pki: Pki) -> None:
    """As name constraints have it (RFC 5280 4.2.1.10): 8 bytes, 10.1.2.0 and its mask."""
    oid = ExtensionOID.SUBJECT_ALTERNATIVE_NAME
    network = b"\x30\x0a\x87\x08\x0a\1\2\0\xff\xff\xff\0"
    pki.issue("odd", names=(), extensions=[x509.UnrecognizedExtension(oid, network)])
    assert names_of(pki.certificate("odd")) == Names()


@given(TEXTS)
def test_what_is_no_name_and_no_network_is_refused(text: str) -> None:
    try:
        wanted = wanted_names([text])
    except ValueError:
        return
    (only,) = map(str, [*wanted.dns, *wanted.networks])
    assert only == text.lower() or "/" in only


@given(st.lists(LABELS, min_size=2, max_size=5), st.lists(LABELS, min_size=2, max_size=5))
def test_a_wildcard_is_one_label(pattern: list[str], name: list[str]) -> None:
    try:
        wanted = wanted_names([".".join(["*", *pattern])])
    except ValueError:
        return
    same_tail = [label.lower() for label in name[1:]] == [label.lower() for label in pattern]
    assert wanted.fit(Names((".".join(name).lower(),))) is same_tail
    assert not wanted.fit(Names(("*." + ".".join(pattern).lower(),)))


def test_the_address_of_a_link_has_a_zone_that_no_certificate_knows() -> None:
    names = Names(addresses=(ip_address("fe80::7"),))
    assert names.hold("fe80::7%eth0")
    assert not names.hold("fe80::8%eth0")
    assert not names.hold("")


def test_only_some_of_many_names_are_shown() -> None:
    assert str(Names(tuple("abcdef"))) == "DNS:a, DNS:b, DNS:c, DNS:d, and 2 more"
