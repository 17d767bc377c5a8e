"""`clients` against a gateway that runs as its user runs it."""

from __future__ import annotations

import asyncio
import json
import socket
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from threading import Thread

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID
from typer.testing import CliRunner

from gateway.cli.app import app
from gateway.clock import SystemClock
from gateway.service.config import load_config
from gateway.service.gateway import Gateway

CONFIG = """
site = "ridge-07"
state_dir = "{folder}"
[history]
enabled = false
[[line]]
name = "shelter-a"
port = "/nonexistent/a"
[[line.device]]
name = "array-1"
address = 1
unit_id = 11
model = "prostar-mppt"
[modbus]
listen = ["127.0.0.1:{modbus}"]
[http]
listen = ["127.0.0.1:{http}"]
{more}
"""


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port: int = probe.getsockname()[1]
        return port


class Running:
    """A gateway on a loop of its own, in a thread."""

    def __init__(self, folder: Path, more: str = "") -> None:
        self.modbus = free_port()
        self.config = folder / "gateway.toml"
        self.config.write_text(CONFIG.format(folder=folder, modbus=self.modbus, http=free_port(), more=more))
        self._loop = asyncio.new_event_loop()
        self._stop = asyncio.Event()
        self._gateway = Gateway(load_config(self.config), SystemClock())
        self._thread = Thread(target=self._run)

    def start(self) -> None:
        self._thread.start()
        asyncio.run_coroutine_threadsafe(self._ready(), self._loop).result(10)

    def stop(self) -> None:
        self._loop.call_soon_threadsafe(self._stop.set)
        self._thread.join(60)
        assert not self._thread.is_alive()

    def _run(self) -> None:
        self._loop.run_until_complete(self._gateway.run(self._stop))
        self._loop.run_until_complete(self._loop.shutdown_default_executor())
        self._loop.close()

    async def _ready(self) -> None:
        async with asyncio.timeout(30):
            while self._gateway.not_ready():  # noqa: ASYNC110 - readiness is polled by everybody
                await asyncio.sleep(0.01)


@pytest.fixture
def running(tmp_path: Path) -> Iterator[Running]:
    gateway = Running(tmp_path)
    gateway.start()
    yield gateway
    gateway.stop()


def run(*arguments: str) -> tuple[int, str, str]:
    result = CliRunner(env={"COLUMNS": "120", "NO_COLOR": "1"}).invoke(app, ["clients", *arguments])
    return result.exit_code, result.stdout, result.stderr


def ask(port: int, count: int) -> None:
    with socket.create_connection(("127.0.0.1", port), 10, ("127.0.0.7", 0)) as client:
        for _ in range(count):
            client.sendall(bytes.fromhex("0001 0000 0006 63 03 0000 0001"))
            assert client.recv(100) == bytes.fromhex("0001 0000 0003 63 83 0a")


def test_nobody_so_far_then_who_asked(running: Running) -> None:
    status, shown, said = run("-c", str(running.config))
    assert (status, said) == (0, "")
    assert "nobody so far" in shown
    ask(running.modbus, 3)
    status, shown, _ = run("-c", str(running.config))
    assert status == 0
    [row] = [row.split() for row in shown.splitlines() if "127.0.0.7" in row]
    assert row[0] == "127.0.0.7"
    assert row[-5:] == ["3", "0.0%", "0", "0", "0A:3"]


def test_a_narrow_terminal_shows_who_it_is(running: Running) -> None:
    ask(running.modbus, 2)
    done = CliRunner(env={"COLUMNS": "80"}).invoke(app, ["clients", "-c", str(running.config)])
    assert done.stdout.splitlines()[2].split() == [
        *("client", "open", "seen", "requests", "memory", "line", "limited", "exceptions")
    ]
    assert "\n 127.0.0.7 " in done.stdout


def test_json_is_what_the_gateway_says(running: Running) -> None:
    ask(running.modbus, 2)
    status, shown, _ = run("-c", str(running.config), "--json")
    assert status == 0
    [client] = json.loads(shown)["clients"]
    assert (client["client"], client["requests"], client["exceptions"]) == ("127.0.0.7", 2, {"0A": 2})


def test_it_shows_the_token_of_the_configuration(tmp_path: Path) -> None:
    token = tmp_path / "token"
    token.write_text("0123456789abcdef\n")
    gateway = Running(tmp_path, more=f'bearer_token_file = "{token}"')
    gateway.start()
    try:
        status, shown, _ = run("-c", str(gateway.config))
        assert status == 0
        assert "nobody so far" in shown
        token.write_text("another-token-0123\n")
        status, _, said = run("-c", str(gateway.config))
        assert status == 1
        assert "401" in said
        assert "another-token" not in said
    finally:
        gateway.stop()


def issued(name: str, by: tuple[x509.Name, ec.EllipticCurvePrivateKey] | None, folder: Path) -> str:
    """Write a certificate and its key as NAME.pem and NAME.key; gives the text of the certificate."""
    key, subject = ec.generate_private_key(ec.SECP256R1()), x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    issuer, signing = (subject, key) if by is None else by
    now = datetime.now(UTC)
    certificate = (
        x509.CertificateBuilder(issuer, subject, key.public_key(), x509.random_serial_number())
        .not_valid_before(now - timedelta(days=1))
        .not_valid_after(now + timedelta(days=1))
        .add_extension(x509.BasicConstraints(ca=name == "between", path_length=None), critical=True)
        .sign(signing, hashes.SHA256())
    )
    private = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    (folder / f"{name}.key").write_bytes(private)
    text = certificate.public_bytes(serialization.Encoding.PEM)
    (folder / f"{name}.pem").write_bytes(text)
    return text.decode()


@pytest.mark.parametrize("kind", ["signed by itself", "issued", "issued, with its issuer"])
def test_the_configured_certificate_is_enough(tmp_path: Path, kind: str) -> None:
    """Such as one of a public authority, whose file ends with an issuer that is no root."""
    authority = (
        x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "authority")]),
        ec.generate_private_key(ec.SECP256R1()),
    )
    if kind == "signed by itself":
        issued("gateway", None, tmp_path)
    elif kind == "issued":
        issued("gateway", authority, tmp_path)
    else:
        between = issued("between", authority, tmp_path)
        key = serialization.load_pem_private_key((tmp_path / "between.key").read_bytes(), None)
        assert isinstance(key, ec.EllipticCurvePrivateKey)
        by = (x509.load_pem_x509_certificate(between.encode()).subject, key)
        (tmp_path / "gateway.pem").write_text(issued("gateway", by, tmp_path) + between)
    files = f'tls_certificate = "{tmp_path / "gateway.pem"}"\ntls_private_key = "{tmp_path / "gateway.key"}"'
    gateway = Running(tmp_path, more=files)
    gateway.start()
    try:
        assert run("-c", str(gateway.config))[0::2] == (0, "")
        issued("stranger", None, tmp_path)
        (tmp_path / "gateway.pem").write_bytes((tmp_path / "stranger.pem").read_bytes())
        status, _, said = run("-c", str(gateway.config))
        assert (status, "certificate verify failed" in said) == (1, True)
    finally:
        gateway.stop()


@pytest.mark.parametrize(
    ("answer", "text"),
    [
        (b"HTTP/1.1 500 \x1b[31mred\r\ncontent-length: 0\r\n\r\n", "500 ?[31mred"),
        (b"HTTP/1.1 200 ok\r\ncontent-length: 3\r\n\r\n[1]", "what answers there is no gateway"),
        (b"HTTP/1.1 200 ok\r\ncontent-length: 2\r\n\r\n{}", "what answers there is no gateway"),
    ],
)
def test_something_else_that_answers_is_named(tmp_path: Path, answer: bytes, text: str) -> None:
    def serve() -> None:
        connection, _ = server.accept()
        with connection:
            connection.recv(1000)
            connection.sendall(answer)

    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        path = tmp_path / "gateway.toml"
        path.write_text(CONFIG.format(folder=tmp_path, modbus=free_port(), http=port, more=""))
        thread = Thread(target=serve)
        thread.start()
        said = run("-c", str(path))
        thread.join()
    assert said == (1, "", f"http://127.0.0.1:{port}/api/v1/clients: {text}\n")


def test_a_gateway_that_does_not_run_is_named(tmp_path: Path) -> None:
    gateway = Running(tmp_path)
    gateway._loop.close()
    status, shown, said = run("-c", str(gateway.config))
    assert (status, shown) == (1, "")
    assert "/api/v1/clients: Connection refused; is the gateway running?" in said


def test_without_an_http_face_there_is_nobody_to_ask(tmp_path: Path) -> None:
    gateway = Running(tmp_path)
    gateway._loop.close()
    text = gateway.config.read_text()
    gateway.config.write_text(text[: text.index("[http]")] + "[http]\nlisten = []\n")
    status, _, said = run("-c", str(gateway.config))
    assert status == 1
    assert "http.listen is empty" in said
