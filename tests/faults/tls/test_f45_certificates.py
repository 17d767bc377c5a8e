"""F45: no certificate, or one that is not good: refused (R-10, R-34, R-44), the reason known, the others unaffected."""

from __future__ import annotations

import asyncio
import logging
import ssl
from collections.abc import Callable

import pytest
from cryptography.x509.oid import ExtendedKeyUsageOID

from tests.faces.modbus.conftest import read
from tests.faces.modbus.tls.conftest import ServeTls, TlsSite
from tests.faces.modbus.tls.site import SERVER, Pki

pytestmark = pytest.mark.peer

Make = Callable[[Pki], str | None]
PDU, REPLY = read(11, 0, 4)


def none(pki: Pki) -> str | None:
    return None


def expired(pki: Pki) -> str | None:
    pki.issue("expired", days=(-2, -0.001))
    return "expired"


def not_yet_valid(pki: Pki) -> str | None:
    pki.issue("early", days=(0.1, 1))
    return "early"


def of_another_authority(pki: Pki) -> str | None:
    pki.authority("stranger")
    pki.issue("impostor", issuer="stranger")
    return "impostor"


def self_signed(pki: Pki) -> str | None:
    pki.authority("stranger")
    return "stranger"


def for_servers(pki: Pki) -> str | None:
    pki.issue("sidekick", usage=SERVER)
    return "sidekick"


def for_mail(pki: Pki) -> str | None:
    pki.issue("mail", usage=ExtendedKeyUsageOID.EMAIL_PROTECTION)
    return "mail"


def issued_by_a_client(pki: Pki) -> str | None:
    pki.issue("child", issuer="operator")
    child, operator = ((pki.folder / f"{name}.pem").read_bytes() for name in ("child", "operator"))
    (pki.folder / "child.pem").write_bytes(child + operator)
    return "child"


async def is_refused(site: TlsSite, name: str | None, version: ssl.TLSVersion | None = None) -> None:
    """The client notices at the latest when it reads."""
    with pytest.raises((ssl.SSLError, ConnectionError, asyncio.IncompleteReadError)):
        await (await site.connect(name, version=version)).query(11, PDU)


@pytest.mark.parametrize("version", [ssl.TLSVersion.TLSv1_2, ssl.TLSVersion.TLSv1_3])
@pytest.mark.parametrize(
    ("make", "reason"),
    [
        (none, "no_certificate"),
        (expired, "certificate_expired"),
        (not_yet_valid, "certificate_not_yet_valid"),
        (of_another_authority, "certificate_invalid"),  # of the same name: the signature is wrong
        (self_signed, "issuer_unknown"),
        (for_servers, "certificate_usage"),
        (for_mail, "certificate_usage"),
        (issued_by_a_client, "certificate_invalid"),
    ],
)
async def test_f45_it_is_refused_and_others_are_served(
    serve_tls: ServeTls, caplog: pytest.LogCaptureFixture, make: Make, reason: str, version: ssl.TLSVersion
) -> None:
    site = await serve_tls()
    name = make(site.pki)
    good = await site.connect("reader")
    with caplog.at_level(logging.WARNING):
        for _ in range(3):
            await is_refused(site, name, version)
            assert await good.query(11, PDU) == REPLY
    await site.running.until(lambda: site.stats.refused.total() == 3)
    assert site.stats.refused == {reason: 3}
    assert site.world.stats.requests == 3
    told = [text for text in caplog.messages if "tls_refused" in text]
    assert told == [f"event=tls_refused peer=127.0.0.1 reason={reason} left_out=0"]  # once a minute
    site.world.clock.now += 61
    with caplog.at_level(logging.WARNING):
        await is_refused(site, name, version)
        await site.running.until(lambda: site.stats.refused.total() == 4)
    assert caplog.messages[-1] == f"event=tls_refused peer=127.0.0.1 reason={reason} left_out=2"


@pytest.mark.parametrize("version", [ssl.TLSVersion.TLSv1, ssl.TLSVersion.TLSv1_1])
async def test_f45_r34_older_versions_are_refused(serve_tls: ServeTls, pki: Pki, version: ssl.TLSVersion) -> None:
    site = await serve_tls()
    context = pki.client("reader")
    context.set_ciphers("ALL:@SECLEVEL=0")  # else this client would not even ask
    with pytest.warns(DeprecationWarning, match="deprecated"):
        context.minimum_version = context.maximum_version = version
    with pytest.raises((ssl.SSLError, ConnectionError)):
        await site.connect(None, context=context)
    await site.running.until(lambda: site.stats.refused.total() == 1)
    assert site.stats.refused == {"version_too_old": 1}


@pytest.mark.parametrize("suites", ["AES128-GCM-SHA256", "ECDHE-ECDSA-AES128-SHA", "NULL-SHA256:@SECLEVEL=0"])
async def test_f45_r50_to_r53_weak_suites_are_refused(serve_tls: ServeTls, pki: Pki, suites: str) -> None:
    site = await serve_tls()
    context = pki.client("reader", ssl.TLSVersion.TLSv1_2)
    context.set_ciphers(suites)
    with pytest.raises((ssl.SSLError, ConnectionError)):
        await site.connect(None, context=context)
    await site.running.until(lambda: site.stats.refused.total() == 1)
    assert site.stats.refused == {"no_shared_cipher": 1}


@pytest.mark.parametrize(
    "first", [b"\0\1\0\0\0\6\13\3\0\0\0\1", b"GET / HTTP/1.1\r\n\r\n", bytes(64), b"\x16\3\1\xff\xff"]
)
async def test_f45_what_is_no_tls_ends(serve_tls: ServeTls, first: bytes) -> None:
    site = await serve_tls(tls={"handshake_timeout_s": 0.2})
    client = await site.running.connect()
    client.send(first)
    assert len(await client.rest()) < 64  # an alert at most
    await site.running.until(lambda: site.stats.refused.total() == 1)
    assert set(site.stats.refused) <= {"not_tls", "protocol_error", "timeout"}


async def test_f45_a_revoked_certificate_is_refused(serve_tls: ServeTls, pki: Pki) -> None:
    pki.revoke()
    site = await serve_tls(crl=True)
    await is_refused(site, "operator")
    assert await (await site.connect("reader")).query(11, PDU) == REPLY
    assert site.stats.refused == {"certificate_revoked": 1}
