"""What a command does with a configuration that is wrong where the command does not look."""

from __future__ import annotations

import tarfile
from pathlib import Path

import pytest
from typer.testing import CliRunner

from gateway.cli.app import app
from gateway.faces.snmp import engine
from tests.cli.test_writes import CONFIG

WRONG_ELSEWHERE = "address = 1000\n"


def run(*arguments: str) -> tuple[int, str, str]:
    result = CliRunner(env={"COLUMNS": "100", "NO_COLOR": "1"}).invoke(app, list(arguments))
    return result.exit_code, result.stdout, result.stderr


@pytest.fixture
def config(tmp_path: Path) -> Path:
    """A file with an impossible address in it, and a state_dir with something in it."""
    (tmp_path / "state").mkdir()
    (tmp_path / "state" / engine.FILE_NAME).write_bytes(engine.state_text(b"x" * 12, 1))
    path = tmp_path / "site.toml"
    path.write_text(CONFIG.format(folder=tmp_path).replace("address = 1\n", WRONG_ELSEWHERE))
    return path


def test_the_ledger_is_shown_and_the_problem_is_mentioned(config: Path) -> None:
    status, shown, said = run("writes", "-c", str(config))
    assert (status, shown) == (0, f"No writes are noted in {config.parent}/state.\n")
    assert said == f"note: check-config names 1 problem in {config}; they do not matter here\n"


def test_a_backup_is_made_and_is_of_the_site(config: Path, tmp_path: Path) -> None:
    archive = tmp_path / "backup.tar"
    status, shown, _ = run("backup", "-c", str(config), str(archive))
    assert (status, shown) == (0, f"{archive}: {engine.FILE_NAME} of {config.parent}/state\n")
    with tarfile.open(archive) as tar:
        head = tar.extractfile(tar.getnames()[0])
        assert head is not None
        assert b'"site": "ridge-07"' in head.read()


@pytest.mark.parametrize("command", [("trace", "shelter-a"), ("clients",)], ids=lambda command: command[0])
def test_a_running_gateway_can_be_asked(config: Path, command: tuple[str, ...]) -> None:
    config.write_text(config.read_text() + '[http]\nlisten = ["127.0.0.1:1"]\n')
    status, _, said = run(command[0], "-c", str(config), *command[1:])
    assert status == 1  # nobody is there, but it was tried
    assert "the gateway" in said.splitlines()[-1]


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ('state_dir = "here"\n', "state_dir: "),
        ('state_dri = "/var/lib/elsewhere"\n', "state_dri: unknown key"),
        ("state_dir = \n", "not TOML"),
        ('site = ""\n', "site: "),
    ],
    ids=["the key itself", "perhaps the key", "no TOML", "another key of it"],
)
def test_what_it_needs_must_be_right(config: Path, tmp_path: Path, text: str, problem: str) -> None:
    key = text.split(" = ", maxsplit=1)[0].replace("dri", "dir")
    lines = [line for line in config.read_text().splitlines(keepends=True) if not line.startswith(key)]
    config.write_text(text + "".join(lines))
    status, shown, said = run("backup", "-c", str(config), str(tmp_path / "backup.tar"))
    assert (status, shown) == (78, "")
    assert problem in said
    assert not (tmp_path / "backup.tar").exists()


@pytest.mark.parametrize(
    "command", [("restore", "backup.tar"), ("log",), ("check-config",), ("run",)], ids=lambda command: command[0]
)
def test_what_needs_all_of_it_is_refused(config: Path, command: tuple[str, ...]) -> None:
    status, shown, said = run(command[0], "-c", str(config), *command[1:])
    assert (status, shown) == (78, "")
    assert "line[0].device[0].address: 1000" in said


def test_quiet_says_nothing_of_a_file_that_is_right_and_names_secrets_that_cannot_be_read(config: Path) -> None:
    right = config.read_text().replace(WRONG_ELSEWHERE, "address = 1\n")
    config.write_text(right)
    assert run("check-config", "--quiet", "-c", str(config)) == (0, "", "")
    missing = config.with_name("noc.auth")
    user = f'[[snmp.user]]\nname = "noc"\nauth_password_file = "{missing}"\npriv_password_file = "{missing}"\n'
    config.write_text(right + user)
    status, shown, said = run("check-config", "--quiet", "-c", str(config))
    assert (status, shown, said.count(str(missing))) == (78, "", 2)
    assert run("check-config", "-c", str(config))[0] == 0  # whoever writes a file need not be who may read its secrets


@pytest.mark.parametrize(
    ("key", "content", "complaint"),
    [
        ("bearer_token_file", "short", "a token has at least 16 printable ASCII characters and no blanks"),
        ("basic_auth_file", "# nobody yet", "holds no name:password line"),
        ("basic_auth_file", "ops", "entry 1 is not name:password"),
        ("tls_certificate", "no certificate", "no certificate with its key in PEM form"),
    ],
)
def test_what_keeps_the_http_face_closed_is_a_problem(config: Path, key: str, content: str, complaint: str) -> None:
    """A gateway that runs refuses to be reloaded with it."""
    file = config.with_name("secret")
    keys = f'{key} = "{file}"\n' + (f'tls_private_key = "{file}"\n' if key == "tls_certificate" else "")
    config.write_text(config.read_text().replace(WRONG_ELSEWHERE, "address = 1\n") + f"[http]\n{keys}")
    assert run("check-config", "-c", str(config))[0] == 0  # whoever writes it need not be who may read its secrets
    status, _, said = run("check-config", "--quiet", "-c", str(config))
    assert (status, f"http.{key}: {file} cannot be read: No such file" in said) == (78, True)
    file.write_text(content)
    for quiet in ((), ("--quiet",)):
        status, _, said = run("check-config", *quiet, "-c", str(config))
        assert status == 78
        assert f"http.{key}: {file}" in said
        assert complaint in said
        assert content not in said.replace(complaint, "")


def test_what_a_reload_would_change_is_told_by_key(config: Path) -> None:
    right = config.read_text().replace(WRONG_ELSEWHERE, "address = 1\n")
    config.write_text(right)
    other = config.with_name("site.new")
    other.write_text(right + '[http]\nlisten = []\n[[snmp.community]]\nname = "a-secret"\nsource = ["::1"]\n')
    status, shown, said = run("check-config", "-c", str(other), "--against", str(config))
    assert (status, shown.split(), said) == (0, ["snmp.community[0]", "http.listen"], "")
    other.write_text(right.replace("/state", "/elsewhere").replace("address = 1\n", "address = 2\n"))
    status, shown, said = run("check-config", "-c", str(other), "--against", str(config))
    assert (status, said) == (0, "")
    assert shown.splitlines() == [
        "state_dir: needs a restart; a reload keeps the old one",
        "line[shelter-a].device[array-1].address",
    ]
    assert run("check-config", "-c", str(config), "--against", str(config))[1].endswith("change nothing else.\n")
    other.write_text("site = 1\n")
    assert run("check-config", "-c", str(other), "--against", str(config))[0] == 78
    assert run("check-config", "-c", str(config), "--against", str(other))[0] == 78
