"""`health`, as an engine of containers asks it."""

from __future__ import annotations

import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from threading import Thread

import pytest
from typer.testing import CliRunner

from gateway.cli import alive, asking
from gateway.cli.app import app
from gateway.service.parsing import HTTP_LISTEN
from gateway.service.schema import HttpTable
from tests.cli.test_clients import Running
from tests.faces.http.test_access import certificate


@pytest.fixture
def running(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Running]:
    """A gateway, by HTTPS and with a token when asked for."""
    more = ""
    if getattr(request, "param", ""):
        crt, key = certificate(tmp_path)
        token = tmp_path / "token"
        token.write_text("0123456789abcdef\n")
        more = f'tls_certificate = "{crt}"\ntls_private_key = "{key}"\nbearer_token_file = "{token}"'
    gateway = Running(tmp_path, more)
    gateway.start()
    yield gateway
    gateway.stop()


def said(capsys: pytest.CaptureFixture[str], path: Path) -> tuple[int, str]:
    status = alive.health(path)
    out, err = capsys.readouterr()
    return status, out + err


@pytest.mark.parametrize("running", ["", "guarded"], indirect=True)
def test_a_gateway_that_answers_is_healthy(running: Running, capsys: pytest.CaptureFixture[str]) -> None:
    status, text = said(capsys, running.config)
    assert status == 0
    assert text.startswith("http")
    assert text.endswith("/healthz: ok\n")


def test_a_configuration_that_waits_for_its_reload_makes_nobody_ill(
    running: Running, capsys: pytest.CaptureFixture[str]
) -> None:
    running.config.write_text(f"nonsense = 1\n{running.config.read_text()}")
    assert said(capsys, running.config)[0] == 0


def test_a_file_as_windows_editors_write_it_is_read(running: Running, capsys: pytest.CaptureFixture[str]) -> None:
    running.config.write_text(f"\ufeff{running.config.read_text()}", newline="\r\n")
    assert said(capsys, running.config)[0] == 0


def test_both_ways_to_call_it_say_the_same(running: Running) -> None:
    call = [sys.executable, "-m", "gateway", "health"]
    for options in (["-c", str(running.config)], ["--config", str(running.config)], [f"--config={running.config}"]):
        done = subprocess.run([*call, *options], capture_output=True, text=True, check=True)
        assert done.stdout.endswith("/healthz: ok\n")


def test_nobody_there(running: Running, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    path = tmp_path / "other.toml"
    path.write_text(f'[http]\nlisten = ["127.0.0.1:{port}"]')
    assert said(capsys, path) == (1, f"http://127.0.0.1:{port}/healthz: Connection refused\n")
    done = CliRunner().invoke(app, ["health", f"--config={path}"])
    assert (done.exit_code, done.stdout) == (1, "")


def test_one_that_hangs_is_given_up(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(asking, "TIMEOUT_S", 0.05)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        path = tmp_path / "site.toml"
        path.write_text(f'[http]\nlisten = ["0.0.0.0:{silent.getsockname()[1]}"]')
        status, text = said(capsys, path)
    assert status == 1
    assert "timed out" in text


@pytest.mark.parametrize(
    ("answer", "text"),
    [
        (b"HTTP/1.1 503 No\r\ncontent-length: 0\r\n\r\n", "503"),
        (b"SSH-2.0-x\r\n", "SSH-2.0-x"),
        (b"\x1b]0;x\x07\x9b2J\r\n", "?]0;x??2J"),
    ],
)
def test_another_answer_is_none(tmp_path: Path, capsys: pytest.CaptureFixture[str], answer: bytes, text: str) -> None:
    def serve(server: socket.socket) -> None:
        connection, _ = server.accept()
        with connection:
            connection.recv(1000)
            connection.sendall(answer)

    with socket.create_server(("127.0.0.1", 0)) as server:
        thread = Thread(target=serve, args=[server])
        thread.start()
        path = tmp_path / "site.toml"
        path.write_text(f'[http]\nlisten = ["127.0.0.1:{server.getsockname()[1]}"]')
        status, shown = said(capsys, path)
        thread.join()
    assert status == 1
    assert text in shown


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("[http]\nlisten = []", "http.listen is empty, so the gateway cannot be asked"),
        ("[http", "not TOML: Expected ']' at the end of a table declaration (at end of document)"),
        ("http = 5", "does not say where the HTTP face is: see check-config"),
        ("[http]\nlisten = 9850", "does not say where the HTTP face is: see check-config"),
        ('[http]\nlisten = "127.0.0.1:9850"', "does not say where the HTTP face is: see check-config"),
        ('[http]\nlisten = ["localhost:9850"]', "does not say where the HTTP face is: see check-config"),
        ("[http]\nlisten = {a = 1}", "does not say where the HTTP face is: see check-config"),
        ("[http]\nlisten = [1]", "does not say where the HTTP face is: see check-config"),
        (None, "cannot be read: No such file or directory"),
    ],
)
def test_a_file_that_names_no_address_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str | None, reason: str
) -> None:
    path = tmp_path / "site.toml"
    if text is not None:
        path.write_text(text)
    assert said(capsys, path) == (1, f"{path}: {reason}\n")


def test_a_file_that_is_too_deep_to_be_read_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "site.toml"
    path.write_text(f"x = {'[' * 5000}")
    status, text = said(capsys, path)
    assert status == 1
    assert text.startswith(f"{path}: not TOML that can be read: ")


def test_it_asks_by_default_where_the_gateway_is_by_default() -> None:
    assert HttpTable().listen == (HTTP_LISTEN,)


def test_nothing_big_is_loaded_for_it(running: Running) -> None:
    code = (
        "import sys; from gateway.cli.main import main\n"
        f"sys.argv = ['prostar-gateway', 'health', '-c', {str(running.config)!r}]\n"
        "try:\n    main()\nexcept SystemExit as left:\n"
        "    print(left.code, [name for name in ('pydantic', 'typer', 'rich', 'asyncio') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "0 []"
