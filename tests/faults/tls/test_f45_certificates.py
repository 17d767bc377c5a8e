"""F45: no certificate, or one that is not good: refused (R-10, R-34, R-44), the reason known, the others unaffected."""

from __future__ import annotations

import asyncio
import logging
import socket
import ssl
import time
from collections.abc import Callable
from dataclasses import replace

import pytest
from cryptography import x509
from cryptography.x509.oid import ExtendedKeyUsageOID

from gateway.faces.modbus.tls_files import load
from gateway.faces.modbus.tls_names import wanted_names
from gateway.faces.modbus.tls_session import REASONS
from gateway.modbus import mbap
from gateway.service.logs import EventFormatter
from tests.faces.modbus.conftest import read
from tests.faces.modbus.tls.conftest import ServeTls, TlsSite
from tests.faces.modbus.tls.site import SERVER, Pki, role, utf8
from tests.faces.modbus.tls.test_tls_serving import s_client

pytestmark = pytest.mark.peer

Make = Callable[[Pki], str | None]
PDU, REPLY = read(11, 0, 4)
READER = role(utf8("reader"))


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
    await is_refused_and_told_once_a_minute(site, caplog, name, reason, version)


async def is_refused_and_told_once_a_minute(
    site: TlsSite, caplog: pytest.LogCaptureFixture, name: str | None, reason: str, version: ssl.TLSVersion
) -> None:
    """Three times, and once more a minute later, while the reader is served; and every time counted."""
    assert reason in REASONS
    good = await site.connect("reader")
    with caplog.at_level(logging.WARNING):
        for _ in range(3):
            await is_refused(site, name, version)
            assert await good.query(11, PDU) == REPLY
    await site.running.until(lambda: site.stats.refused.total() == 3)
    assert site.stats.refused == {reason: 3}
    assert site.world.stats.requests == 3
    (told,) = [text for text in caplog.messages if "tls_refused" in text]
    assert told.startswith(f"event=tls_refused peer=127.0.0.1 reason={reason} left_out=0")
    site.world.clock.now += 61
    with caplog.at_level(logging.WARNING):
        await is_refused(site, name, version)
        await site.running.until(lambda: site.stats.refused.total() == 4)
    assert caplog.messages[-1] == told.replace("left_out=0", "left_out=2")


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


OPERATORS = ("scada.example.net", "*.control.example.net", "10.1.2.0/28", "2001:db8::7")


@pytest.mark.parametrize("version", [ssl.TLSVersion.TLSv1_2, ssl.TLSVersion.TLSv1_3])
@pytest.mark.parametrize(
    "shown",
    [
        "none",
        "DNS:historian.example.net, IP:192.0.2.9",
        "DNS:scada.example.net.example.org, DNS:scada.example, DNS:example.net",
        "DNS:control.example.net, DNS:a.b.control.example.net",
        "DNS:*.control.example.net",
        "DNS:10.1.2.7.example.net, IP:10.1.2.16, IP:2001:db8::8",
    ],
)
async def test_f45_a_certificate_of_another_name_is_refused(
    serve_tls: ServeTls, caplog: pytest.LogCaptureFixture, shown: str, version: ssl.TLSVersion
) -> None:
    site = await serve_tls(tls={"client_names": wanted_names((*OPERATORS, "reader.example.net"))})
    site.pki.issue("reader", names=("reader.example.net",), extensions=[READER])
    names = [] if shown == "none" else [text.partition(":")[2] for text in shown.split(", ")]
    site.pki.issue("stranger", names=names, extensions=[READER])
    await is_refused_and_told_once_a_minute(site, caplog, "stranger", "name_not_allowed", version)
    assert caplog.messages[-1].endswith(f'why="its names: {shown}"')


@pytest.mark.parametrize(
    "names",
    [
        ("scada.example.net",),
        ("SCADA.Example.NET",),
        ("elsewhere.example.net", "scada.example.net"),
        ("desk-7.control.example.net",),
        ("10.1.2.15",),
        ("2001:db8:0::7",),
    ],
)
async def test_f45_one_name_that_is_wanted_is_enough(serve_tls: ServeTls, pki: Pki, names: tuple[str, ...]) -> None:
    site = await serve_tls(tls={"client_names": wanted_names(OPERATORS)})
    pki.issue("someone", names=names, extensions=[READER])
    assert await (await site.connect("someone")).query(11, PDU) == REPLY
    assert site.stats.refused.total() == 0


async def test_f45_no_other_entry_and_no_common_name_is_taken_for_a_name(serve_tls: ServeTls, pki: Pki) -> None:
    site = await serve_tls(tls={"client_names": wanted_names(OPERATORS)})
    others = x509.SubjectAlternativeName(
        [
            x509.RFC822Name("scada.example.net"),
            x509.UniformResourceIdentifier("scada.example.net"),
            x509.DNSName("scada.example.net\0.example.org"),
        ]
    )
    pki.issue("scada.example.net", names=(), extensions=[READER, others])  # that is its common name too
    await is_refused(site, "scada.example.net")
    assert site.stats.refused == {"name_not_allowed": 1}


@pytest.mark.parametrize(
    "evil", ['x\n" level=error event=forged\r\n', '\x1b[31m\x7f.example.net"\\', "historian.example.net\n", '"']
)
async def test_f45_no_name_in_a_certificate_writes_into_the_log(
    serve_tls: ServeTls, pki: Pki, caplog: pytest.LogCaptureFixture, evil: str
) -> None:
    site = await serve_tls(tls={"client_names": wanted_names(OPERATORS)})
    pki.issue("named", names=(evil, "historian.example.net", f"{evil}.example.net"), extensions=[READER])
    pki.issue("roled", names=OPERATORS[:1], extensions=[role(utf8(evil))])
    cases = (
        ("named", "name_not_allowed", "its names: DNS:historian.example.net"),
        ("roled", "role_malformed", "a role has 1 to 64 printable characters and no quotes"),
    )
    for name, reason, why in cases:
        with caplog.at_level(logging.INFO):
            await is_refused(site, name)
            await site.running.until(lambda: reason in site.stats.refused)  # noqa: B023 - waited for in its turn
        expected = f'event=tls_refused peer=127.0.0.1 reason={reason} left_out=0 why="{why}"'
        assert EventFormatter().format(caplog.records[-1]).endswith(f" level=warning {expected}")


async def test_f45_a_certificate_is_good_at_its_own_address_only(
    serve_tls: ServeTls, pki: Pki, caplog: pytest.LogCaptureFixture
) -> None:
    site = await serve_tls(tls={"require_address": True})
    pki.issue("reader", names=("localhost", "127.0.0.1"), extensions=[READER])
    pki.issue("away", names=("localhost", "127.0.0.2", "127.0.0.3"), extensions=[READER])
    for host in ("127.0.0.2", "127.0.0.3"):
        assert await (await site.connect("away", local_addr=(host, 0))).query(11, PDU) == REPLY
    site.world.stats.requests -= 2
    version = ssl.TLSVersion.TLSv1_3
    await is_refused_and_told_once_a_minute(site, caplog, "away", "address_not_in_certificate", version)


async def test_f45_the_certificates_of_the_recipe_have_names_to_tell_them_by(serve_tls: ServeTls) -> None:
    site = await serve_tls(tls={"client_names": wanted_names(["scada.example.net"])})
    assert await (await site.connect("operator")).query(11, PDU) == REPLY
    await is_refused(site, "reader")
    assert site.stats.refused == {"name_not_allowed": 1}


async def test_f45_both_conditions_must_hold(serve_tls: ServeTls, pki: Pki) -> None:
    site = await serve_tls(tls={"client_names": wanted_names(OPERATORS), "require_address": True})
    for name, names in (
        ("both", ("scada.example.net", "127.0.0.1")),
        ("name", OPERATORS[:1]),
        ("here", ("127.0.0.1",)),
    ):
        pki.issue(name, names=names, extensions=[READER])
    assert await (await site.connect("both")).query(11, PDU) == REPLY
    await is_refused(site, "name")
    await is_refused(site, "here")
    assert site.stats.refused == {"address_not_in_certificate": 1, "name_not_allowed": 1}


async def test_f45_names_wanted_from_a_reload_on_end_the_connections_without(
    serve_tls: ServeTls, pki: Pki, caplog: pytest.LogCaptureFixture
) -> None:
    site = await serve_tls()
    pki.issue("scada", names=OPERATORS[:1], extensions=[READER])
    scada, reader = await site.connect("scada"), await site.connect("reader")
    await site.running.until(lambda: site.stats.handshakes == 2)
    before = site.running.server.settings.tls
    assert before is not None
    with caplog.at_level(logging.WARNING):
        site.door.adjust(replace(before, client_names=wanted_names(OPERATORS)), load(before.files, time.time()))
    assert await reader.rest() == b""
    assert await scada.query(11, PDU) == REPLY
    assert "event=connection_ended peer=127.0.0.1 reason=name_not_allowed" in caplog.messages
    assert site.world.stats.closed == {"name_not_allowed": 1}


# The other way round: a client that checks whose certificate the server has


@pytest.mark.parametrize(
    "check",
    [("-verify_hostname", "localhost"), ("-verify_hostname", "gateway.example.net"), ("-verify_ip", "127.0.0.1")],
)
async def test_f45_the_certificate_of_the_recipe_stands_the_check_of_a_client(
    serve_tls: ServeTls, peer: Callable[[str], str], check: tuple[str, str]
) -> None:
    site = await serve_tls()
    request, reply = mbap.encode(7, 11, PDU), mbap.encode(7, 11, REPLY)
    got, said = await s_client(site, peer("openssl"), "-quiet", "-no_ign_eof", *check, request=request)
    assert got == reply, said


@pytest.mark.parametrize("version", ["-tls1_2", "-tls1_3"])
@pytest.mark.parametrize(
    "check", [("-verify_hostname", "another.example.net"), ("-verify_ip", "192.0.2.7"), ("-verify_ip", "127.0.0.2")]
)
async def test_f45_a_client_that_expects_another_server_does_not_talk(
    serve_tls: ServeTls, peer: Callable[[str], str], check: tuple[str, str], version: str
) -> None:
    site = await serve_tls()
    _, said = await s_client(site, peer("openssl"), version, *check)
    assert "mismatch" in said
    await site.running.until(lambda: site.stats.refused.total() == 1)
    assert site.stats.refused == {"refused_by_client": 1}
    assert site.world.stats.requests == 0


def shake_hands(context: ssl.SSLContext, address: tuple[str, int]) -> None:
    """As a client that connects to "localhost" and sees to it that it is there."""
    assert context.check_hostname
    with socket.create_connection(address, timeout=60) as plain:
        context.wrap_socket(plain, server_hostname="localhost").close()


@pytest.mark.parametrize("version", [ssl.TLSVersion.TLSv1_2, ssl.TLSVersion.TLSv1_3])
@pytest.mark.parametrize("names", [(), ("elsewhere.example.net", "127.0.0.2"), ("*",), ("localhost.example.net",)])
async def test_f45_a_server_of_another_name_is_refused_by_its_clients(
    serve_tls: ServeTls, pki: Pki, names: tuple[str, ...], version: ssl.TLSVersion
) -> None:
    pki.issue("server", usage=SERVER, names=names)
    site = await serve_tls()
    with pytest.raises(ssl.SSLCertVerificationError, match=r"[Hh]ostname mismatch"):
        await asyncio.to_thread(shake_hands, pki.client("reader", version), site.running.address)
    await site.running.until(lambda: site.stats.refused.total() == 1)
    assert site.stats.refused == {"refused_by_client": 1}
