"""F62: what would make SNMPv3 worthless is refused at check-config, with the reason (RFC 3414 §11.2)."""

from __future__ import annotations

import json
import pickle
import signal
import stat
import sys
from pathlib import Path

import pytest

from gateway.cli.main import main
from gateway.errors import ConfigError
from gateway.faces.snmp.secret import Secret
from gateway.faces.snmp.usm import Auth, Credentials, Priv
from gateway.service.config import load_config, parse_config
from gateway.service.snmp import read_pass_phrase, snmp_settings

PHRASE = "correct horse battery"


def user(folder: Path, **changes: str) -> str:
    """A configuration with one SNMPv3 user."""
    keys = {
        "auth": "SHA-256",
        "auth_password_file": str(folder / "auth"),
        "priv": "AES-128",
        "priv_password_file": str(folder / "priv"),
    } | changes
    return (
        f'site = "a"\nstate_dir = "{folder}"\n[[line]]\nname = "l"\nport = "/dev/l"\n[[line.device]]\nname = "d"\n'
        'address = 1\nunit_id = 1\nmodel = "prostar-mppt"\n[[snmp.user]]\nname = "noc"\n'
    ) + "".join(f"{key} = {json.dumps(value)}\n" for key, value in keys.items())


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in ("auth", "priv"):
        path = tmp_path / name
        path.write_text(PHRASE + "\n")
        path.chmod(stat.S_IRUSR | stat.S_IWUSR)
    return tmp_path


def run(*arguments: str) -> int:
    """Exit status of a command; this process handles signals and prints as before afterwards."""
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    blocked = signal.pthread_sigmask(signal.SIG_BLOCK, ())
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["prostar-gateway", *arguments])
        patch.setattr(sys, "stdout", sys.stdout)
        patch.setattr(sys, "stderr", sys.stderr)
        with pytest.raises(SystemExit) as left:
            main()
    for number, handler in handlers.items():
        signal.signal(number, handler)
    signal.pthread_sigmask(signal.SIG_SETMASK, blocked)
    return int(left.value.code or 0)


def problems(text: str) -> tuple[str, ...]:
    with pytest.raises(ConfigError) as caught:
        parse_config(text)
    return caught.value.problems


def test_a_right_user_becomes_credentials(folder: Path) -> None:
    found = snmp_settings(parse_config(user(folder)))
    (only,) = found.users
    assert only.credentials == Credentials(
        b"noc", Auth.SHA_256, Secret(PHRASE.encode()), Priv.AES_128, Secret(PHRASE.encode())
    )
    assert [str(network) for network in only.sources] == ["127.0.0.0/8", "::1/128"]
    assert (found.listen, found.state_dir, found.v1) == ((("127.0.0.1", 1161),), folder, False)


@pytest.mark.parametrize("auth", ["MD5", "SHA", "SHA-1", "sha-256", ""])
def test_broken_digests_are_refused_with_the_reason(folder: Path, auth: str) -> None:
    (problem,) = problems(user(folder, auth=auth))
    assert problem.startswith(f"config: snmp.user[0].auth: {json.dumps(auth)} is not allowed")
    assert "MD5 and SHA-1, which are broken" in problem


@pytest.mark.parametrize("priv", ["DES", "3DES", "AES", ""])
def test_broken_ciphers_are_refused_with_the_reason(folder: Path, priv: str) -> None:
    (problem,) = problems(user(folder, priv=priv))
    assert problem.startswith(f"config: snmp.user[0].priv: {json.dumps(priv)} is not allowed")
    assert "not DES, which is broken" in problem


def test_a_key_that_the_digest_cannot_fill_is_refused(folder: Path) -> None:
    (problem,) = problems(user(folder, auth="SHA-224", priv="AES-256"))
    assert problem.startswith('config: snmp.user[0].priv: "AES-256" needs a longer digest than SHA-224\'s')
    parse_config(user(folder, auth="SHA-224", priv="AES-192"))


@pytest.mark.parametrize("key", ["auth_password_file", "priv_password_file"])
@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ("seven77\n", "holds fewer than 8 characters"),
        ("", "holds fewer than 8 characters"),
        ("one line of it\nanother\n", "holds more than one line"),
        ("x" * 2000, "holds more than one line"),
    ],
)
def test_bad_pass_phrases_are_refused_and_not_shown(folder: Path, key: str, content: str, reason: str) -> None:
    (folder / "bad").write_text(content)
    (problem,) = problems(user(folder, **{key: str(folder / "bad")}))
    assert problem.startswith(f"config: snmp.user[0].{key}: ")
    assert reason in problem
    assert "seven77" not in problem


def test_check_config_exits_78_for_a_short_pass_phrase(folder: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (folder / "auth").write_text("hunter2")
    (folder / "c.toml").write_text(user(folder))
    assert run("check-config", "-c", str(folder / "c.toml")) == 78
    said = capfd.readouterr()
    assert "snmp.user[0].auth_password_file" in said.err
    assert "RFC 3414 §11.2" in said.err
    assert "hunter2" not in said.out + said.err


@pytest.mark.parametrize(
    ("key", "table"),
    [("snmp.user[0]", "[[snmp.user]]"), ("modbus.tls", "[modbus.tls]")],
)
def test_without_the_library_that_encrypts_it_is_refused(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], key: str, table: str
) -> None:
    text = user(folder)
    if table not in text:
        files = "".join(f'{name}_file = "{folder}/none"\n' for name in ("certificate", "key", "client_ca"))
        text = f"{text.partition('[[snmp')[0]}{table}\n{files}"
    (folder / "c.toml").write_text(text)
    monkeypatch.setitem(sys.modules, "cryptography", None)
    (folder / "sitecustomize.py").write_text('import sys\nsys.modules["cryptography"] = None\n')
    monkeypatch.syspath_prepend(folder)  # where the process that reads for `run` finds that
    for command in ("check-config", "run"):
        assert run(command, "-c", str(folder / "c.toml")) == 78
        assert f"{key}: needs the Python package cryptography, which is not installed" in capfd.readouterr().err


def test_a_missing_pass_phrase_is_advice_when_checked_and_stops_the_start(
    folder: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (folder / "priv").unlink()
    (folder / "auth").chmod(0o644)
    (folder / "c.toml").write_text(user(folder))
    assert run("check-config", "-c", str(folder / "c.toml")) == 0
    shown = capfd.readouterr().out
    assert f"snmp.user[0].priv_password_file: {folder}/priv cannot be read: No such file" in shown
    assert f"snmp.user[0].auth_password_file: {folder}/auth is open to every user of this machine (mode 644)" in shown
    assert run("run", "-c", str(folder / "c.toml")) == 78
    assert "snmp.user[0].priv_password_file" in capfd.readouterr().err
    with pytest.raises(ConfigError, match=r"snmp\.user\[0\]\.priv_password_file: .*priv cannot be read"):
        snmp_settings(load_config(folder / "c.toml"))


def test_a_bare_name_is_a_systemd_credential(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CREDENTIALS_DIRECTORY", str(folder))
    assert read_pass_phrase("auth") == Secret(PHRASE.encode())
    settings = snmp_settings(parse_config(user(folder, auth_password_file="auth")))
    assert settings.users[0].credentials.auth_password == Secret(PHRASE.encode())


def test_no_text_form_shows_a_secret(folder: Path) -> None:
    config = parse_config(user(folder))
    settings = snmp_settings(config)
    secret = settings.users[0].credentials.auth_password
    shown = [repr(settings), str(settings), repr(config), f"{secret}", str(secret), repr([secret])]
    assert not any(PHRASE in text for text in shown)
    with pytest.raises(TypeError):
        json.dumps(secret)
    with pytest.raises(TypeError, match="not copied or stored"):
        pickle.dumps(secret)


@pytest.mark.parametrize("short", ["auth_password", "priv_password"])
def test_the_face_itself_takes_no_short_pass_phrase(short: str) -> None:
    fields = {"auth_password": Secret(PHRASE.encode()), "priv_password": Secret(PHRASE.encode())}
    fields[short] = Secret(b"seven77")
    with pytest.raises(ValueError, match="shorter than 8"):
        Credentials(b"noc", Auth.SHA_256, fields["auth_password"], Priv.AES_128, fields["priv_password"])
    with pytest.raises(ValueError, match="too short a key"):
        Credentials(b"noc", Auth.SHA_224, Secret(b"x" * 8), Priv.AES_256, Secret(b"y" * 8))
