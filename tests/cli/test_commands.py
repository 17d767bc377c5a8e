"""The command line from outside: names, exit statuses, where the output goes."""

from __future__ import annotations

import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest
from typer.testing import CliRunner

from gateway.cli.app import app
from gateway.service.config import load_config
from gateway.service.settings import line_budgets

REPOSITORY = Path(__file__).parents[2]
CONFIGS = REPOSITORY / "config"


def run(*arguments: str) -> tuple[int, str, str]:
    result = CliRunner(env={"COLUMNS": "100", "NO_COLOR": "1"}).invoke(app, list(arguments))
    return result.exit_code, result.stdout, result.stderr


@pytest.mark.parametrize(
    "command", [[sys.executable, "-m", "gateway"], [str(Path(sys.executable).with_name("prostar-gateway"))]]
)
def test_the_command_and_the_module_are_the_same(command: list[str]) -> None:
    done = subprocess.run([*command, "--version"], capture_output=True, text=True, check=True)
    assert done.stdout == f"prostar-gateway {version('prostar-gateway')}\n"


def test_help_names_every_command() -> None:
    status, shown, _ = run("--help")
    assert status == 0
    for command in ("run", "check-config", "demo", "simulate", "scan", "clients", "generate"):
        assert f" {command} " in shown


def test_check_config_shows_what_the_lines_can_do() -> None:
    status, shown, said = run("check-config", "-c", str(CONFIGS / "full.toml"))
    assert (status, said) == (0, "")
    rows = [row.split() for row in shown.splitlines()]
    assert [row[0] for row in rows if row and row[-1] == "s" and row[0].startswith("shelter")] == [
        "shelter-a",
        "shelter-b",
    ]
    line_a = next(row for row in rows if row and row[0] == "shelter-a")
    budget = line_budgets(load_config(CONFIGS / "full.toml"))[0]
    assert line_a[-4:] == ["2", f"{budget.use_ratio:.0%}", f"{budget.reply_deadline_s:.1f}", "s"]
    by_unit = {row[0]: row for row in rows if len(row) > 5 and row[0].isdigit()}
    assert list(by_unit) == ["11", "12", "13", "14", "15"]
    assert by_unit["13"] == ["13", "array-3", "shelter-b", "1", "prostar-mppt", "1.0", "s", "300", "s"]
    modbus = "Modbus TCP 127.0.0.1:1502 · line shelter-a 127.0.0.1:1503"
    assert f"Faces  {modbus}\n       SNMP 127.0.0.1:1161\n       HTTP 127.0.0.1:9850\n" in shown
    assert "EMC-1  unit 11 127.0.0.1:1162\n" in shown
    assert "warning snmp.enterprise_root: 32473" in shown
    assert shown.endswith("full.toml is right.\n")
    assert "k7-ridge-reader" not in shown


def test_check_config_warns_of_a_line_that_is_too_busy(tmp_path: Path) -> None:
    text = 'site = "a"\n[[line]]\nname = "[bold]"\nport = "/dev/a"\n'
    for n in range(1, 9):
        text += f'[[line.device]]\nname = "d{n}"\naddress = {n}\nunit_id = {n}\nmodel = "prostar-mppt"\n'
    path = tmp_path / "site.toml"
    path.write_text(text)
    status, shown, _ = run("check-config", "-c", str(path))
    assert status == 0
    assert "[bold]" in shown  # a name is not markup
    assert "warning line[0]: polling would take 21" in shown
    assert "SNMP off (no community, no user)" in shown


@pytest.mark.parametrize("command", ["run", "check-config"])
def test_a_missing_file_is_a_bad_config(command: str, tmp_path: Path) -> None:
    status, shown, said = run(command, "-c", str(tmp_path / "no.toml"))
    assert (status, shown) == (78, "")
    assert said.splitlines()[0] == f"{tmp_path / 'no.toml'}: cannot be read: No such file or directory"


def test_a_config_must_be_named() -> None:
    status, _, said = run("run")
    assert status == 2
    assert "--config" in said


def test_a_loop_that_is_not_installed_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "uvloop", None)
    status, _, said = run("run", "-c", str(CONFIGS / "minimal.toml"), "--loop", "uvloop")
    assert status == 2
    assert "uvloop is not installed" in said
