"""Passwords, tokens and TLS: who gets an answer, and what nobody gets to see."""

from __future__ import annotations

import asyncio
import base64
import logging
import shutil
import ssl
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from aiohttp import ClientSession
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID
from hypothesis import given
from hypothesis import strategies as st

from gateway.errors import ListenError
from gateway.faces.http.access import Access, read_passwords, read_token, tls_context
from gateway.faces.http.settings import HttpSettings

from .conftest import Gateway

MakeGateway = Callable[..., Gateway]
TOKEN = "a-token-of-more-than-16"


def written(folder: Path, name: str, text: str | bytes) -> str:
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return str(path)


def basic(shown: str) -> str:
    return f"Basic {base64.b64encode(shown.encode()).decode()}"


@pytest.fixture
def users(tmp_path: Path) -> str:
    return written(tmp_path, "users", "# who may ask\nprometheus:s3cret:with colon\n\nzoë:pässwort\n")


@pytest.fixture
def token(tmp_path: Path) -> str:
    return written(tmp_path, "token", f"{TOKEN}\n")


async def test_a_password_is_asked_for_and_taken(make_gateway: MakeGateway, users: str) -> None:
    async with make_gateway(basic_auth_file=users).running() as gateway, ClientSession() as session:
        async with session.get(f"{gateway.url}/metrics") as reply:
            assert reply.status == 401
            assert reply.headers["WWW-Authenticate"] == 'Basic realm="prostar-gateway", charset="UTF-8"'
            assert "morningstar" not in await reply.text()
        for name, password in (("prometheus", "s3cret:with colon"), ("zoë", "pässwort")):
            shown = {"Authorization": basic(f"{name}:{password}")}
            async with session.get(f"{gateway.url}/metrics", headers=shown) as reply:
                assert reply.status == 200
        assert gateway.face.stats.refused == 1


async def test_a_token_is_asked_for_and_taken(make_gateway: MakeGateway, token: str) -> None:
    async with make_gateway(bearer_token_file=token).running() as gateway, ClientSession() as session:
        async with session.get(f"{gateway.url}/sd") as reply:
            assert (reply.status, reply.headers["WWW-Authenticate"]) == (401, 'Bearer realm="prostar-gateway"')
        async with session.get(f"{gateway.url}/sd", headers={"Authorization": f"Bearer {TOKEN}"}) as reply:
            assert reply.status == 200


@pytest.mark.parametrize("path", ["/", "/metrics", "/sd", "/readyz", "/nothing-here"])
async def test_everything_but_healthz_is_guarded(make_gateway: MakeGateway, users: str, token: str, path: str) -> None:
    async with (
        make_gateway(basic_auth_file=users, bearer_token_file=token).running() as gateway,
        ClientSession() as session,
    ):
        async with session.get(gateway.url + path) as reply:
            assert reply.status == 401
            assert len(reply.headers.getall("WWW-Authenticate")) == 2
        async with session.get(f"{gateway.url}/healthz") as reply:
            assert reply.status == 200


@pytest.mark.parametrize(
    "authorization",
    [
        "",
        "Basic",
        "Basic !!!",
        basic("prometheus"),
        basic("prometheus:s3cret"),
        basic("prometheus:s3cret:with colon "),
        "Bearer",
        f"Bearer {TOKEN[:-1]}",
        f"Bearer {TOKEN}x",
        f"Digest {TOKEN}",
        TOKEN,
    ],
)
def test_wrong_credentials(users: str, token: str, authorization: str) -> None:
    access = Access.read(HttpSettings(basic_auth_file=users, bearer_token_file=token))
    assert not access.admits(authorization)


@given(st.text() | st.text().map(lambda text: f"Basic {text}") | st.text().map(lambda text: f"bearer {text}"))
def test_any_header_is_admitted_or_not(authorization: str) -> None:
    assert Access().admits(authorization)
    assert not Access(passwords=(b"\0" * 32,), token=b"\0" * 32).admits(authorization)


def test_every_password_is_compared(users: str, monkeypatch: pytest.MonkeyPatch) -> None:
    compared = 0

    def counting(one: bytes, other: bytes) -> bool:
        nonlocal compared
        compared += 1
        return one == other

    access = Access.read(HttpSettings(basic_auth_file=users))
    monkeypatch.setattr("gateway.faces.http.access.hmac.compare_digest", counting)
    assert access.admits(basic("prometheus:s3cret:with colon"))
    assert compared == 2, "it stopped at the first that fits, which tells how many there are before it"


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("", "holds no name:password line"),
        ("# nobody\n", "holds no name:password line"),
        ("prometheus\n", "entry 1 is not name:password"),
        ("a:b\n:secret\n", "entry 2 is not name:password"),
        ("a:b\nname:\n", "entry 2 is not name:password"),
    ],
)
def test_password_files_that_cannot_be_used(tmp_path: Path, text: str, complaint: str) -> None:
    path = written(tmp_path, "users", text)
    with pytest.raises(ListenError, match=f"^{path}: {complaint}$"):
        read_passwords(path)


@pytest.mark.parametrize("text", ["", "short", "with a blank in the middle", "1234567890123456\nsecond"])
def test_token_files_that_cannot_be_used(tmp_path: Path, text: str) -> None:
    path = written(tmp_path, "token", text)
    with pytest.raises(ListenError, match="a token has at least 16 printable ASCII characters"):
        read_token(path)


@pytest.mark.parametrize("key", ["basic_auth_file", "bearer_token_file", "tls_certificate"])
async def test_a_missing_file_keeps_the_listener_closed_until_it_is_there(
    make_gateway: MakeGateway, tmp_path: Path, key: str
) -> None:
    path = tmp_path / "later"
    gateway = make_gateway(**{key: str(path)})
    [listener] = gateway.face.listeners
    with pytest.raises(ListenError, match=rf"^http 127\.0\.0\.1:0: {path}: No such file or directory$"):
        await listener.start()
    assert listener.bound is None
    if key == "bearer_token_file":
        path.write_text(TOKEN)
        async with gateway.running(), ClientSession() as session, session.get(f"{gateway.url}/metrics") as reply:
            assert reply.status == 401


async def test_no_secret_is_written_anywhere(
    make_gateway: MakeGateway, users: str, token: str, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.DEBUG)
    settings = HttpSettings(basic_auth_file=users, bearer_token_file=token)
    access = Access.read(settings)
    async with (
        make_gateway(basic_auth_file=users, bearer_token_file=token).running() as gateway,
        ClientSession() as session,
        session.get(f"{gateway.url}/metrics", headers={"Authorization": f"Bearer {TOKEN}"}) as reply,
    ):
        page = await reply.text()
    for text in (repr(access), repr(settings), caplog.text, page):
        assert TOKEN not in text
        assert "s3cret" not in text
        assert repr(access.token) not in text


def certificate(folder: Path, password: bytes | None = None) -> tuple[str, str]:
    """Paths of a certificate for 127.0.0.1 and of its key."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "127.0.0.1")])
    now = datetime.now(UTC)
    made = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(1)
        .not_valid_before(now - timedelta(days=1))
        .not_valid_after(now + timedelta(days=1))
        .sign(key, hashes.SHA256())
    )
    sealed = serialization.BestAvailableEncryption(password) if password else serialization.NoEncryption()
    return (
        written(folder, "crt", made.public_bytes(serialization.Encoding.PEM)),
        written(
            folder,
            "key",
            key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, sealed),
        ),
    )


async def test_https(make_gateway: MakeGateway, tmp_path: Path) -> None:
    crt, key = certificate(tmp_path)
    trusting = ssl.create_default_context(cafile=crt)
    trusting.check_hostname = False
    gateway = make_gateway(tls_certificate=crt, tls_private_key=key)
    async with gateway.running(), ClientSession() as session:
        url = gateway.url.replace("http:", "https:")
        async with session.get(f"{url}/metrics", ssl=trusting) as reply:
            assert reply.status == 200
            assert "morningstar_up" in await reply.text()
        async with session.get(f"{url}/sd", ssl=trusting) as reply:
            [found] = await reply.json()
            assert found["labels"]["__scheme__"] == "https"
            assert found["targets"] == [url.removeprefix("https://")]


def test_old_tls_is_refused(tmp_path: Path) -> None:
    crt, key = certificate(tmp_path)
    server = tls_context(HttpSettings(tls_certificate=crt, tls_private_key=key))
    assert server is not None
    client = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    client.check_hostname, client.verify_mode = False, ssl.CERT_NONE
    with pytest.warns(DeprecationWarning, match="TLSv1_1"):
        client.minimum_version = client.maximum_version = ssl.TLSVersion.TLSv1_1
    client.set_ciphers("ALL:@SECLEVEL=0")
    to_server, to_client = ssl.MemoryBIO(), ssl.MemoryBIO()
    asking = client.wrap_bio(to_client, to_server)
    answering = server.wrap_bio(to_server, to_client, server_side=True)
    with pytest.raises(ssl.SSLWantReadError):
        asking.do_handshake()
    with pytest.raises(ssl.SSLError, match=r"(?i)unsupported.protocol"):
        answering.do_handshake()


@pytest.mark.parametrize("broken", ["password", "other key", "no certificate"])
async def test_a_certificate_that_cannot_be_used_is_named(
    make_gateway: MakeGateway, tmp_path: Path, broken: str
) -> None:
    crt, key = certificate(tmp_path, password=b"hunter2-hunter2" if broken == "password" else None)
    if broken == "other key":
        (tmp_path / "second").mkdir()
        _, key = certificate(tmp_path / "second")
    elif broken == "no certificate":
        written(tmp_path, "crt", "hello")
    [listener] = make_gateway(tls_certificate=crt, tls_private_key=key).face.listeners
    with pytest.raises(
        ListenError, match=rf"^http 127\.0\.0\.1:0: {crt} and {key}: no certificate with its key"
    ) as told:
        await listener.start()
    assert "hunter2" not in str(told.value)


async def shown_certificate(gateway: Gateway) -> bytes:
    """What a new connection is shown, as DER."""
    trusting = ssl.create_default_context()
    trusting.check_hostname, trusting.verify_mode = False, ssl.CERT_NONE
    host, port = gateway.url.removeprefix("http://").split(":")
    _, writer = await asyncio.open_connection(host, int(port), ssl=trusting)
    shown = writer.get_extra_info("ssl_object").getpeercert(binary_form=True)
    writer.close()
    assert isinstance(shown, bytes)
    return shown


@pytest.mark.parametrize("renewed", ["crt", "key"])
async def test_files_are_read_when_that_is_asked_for_and_not_before(
    make_gateway: MakeGateway, tmp_path: Path, renewed: str
) -> None:
    """Half of a renewed pair on disk, while the face goes on by other settings for another reason, costs nothing."""
    crt, key = certificate(tmp_path)
    (tmp_path / "second").mkdir()
    other = dict(zip(("crt", "key"), certificate(tmp_path / "second"), strict=True))
    gateway = make_gateway(tls_certificate=crt, tls_private_key=key)
    settings = HttpSettings((("127.0.0.1", 0),), tls_certificate=crt, tls_private_key=key)

    def adjust(tls: ssl.SSLContext | None) -> None:
        nothing: dict[str, None] = dict.fromkeys(("history", "log", "conditions"))
        gateway.face.adjust(settings, Access(), gateway.site, tls=tls, notifications=(), **nothing)

    async with gateway.running():
        first = await shown_certificate(gateway)
        shutil.copy(other[renewed], tmp_path / renewed)
        adjust(None)
        assert await shown_certificate(gateway) == first
        for name, path in other.items():
            shutil.copy(path, tmp_path / name)
        adjust(tls_context(settings))
        assert await shown_certificate(gateway) != first
