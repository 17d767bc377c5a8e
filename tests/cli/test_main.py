"""Signals before and while the commands are loaded."""

from __future__ import annotations

import ast
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from gateway.cli import main as module
from tests.e2e.programs import GATEWAY, wait_until

SITE = """
site = "r\u00eddge"
state_dir = "{folder}"
[[line]]
name = "shelter-a"
port = "/dev/ttyS0"
[[line.device]]
name = "\u5c71-1"
address = 1
unit_id = 11
model = "prostar-mppt"
[modbus]
listen = []
[snmp]
listen = []
[http]
listen = []
"""


@pytest.mark.parametrize(
    ("arguments", "number", "status"),
    [
        (["run", "-c", "x"], signal.SIGTERM, 0),
        (["demo"], signal.SIGINT, 0),
        (["simulate"], signal.SIGINT, 0),
        (["generate", "--check"], signal.SIGINT, 130),
        (["check-config"], signal.SIGTERM, 143),
        ([], signal.SIGINT, 130),
    ],
)
def test_a_signal_ends_it_quietly(
    monkeypatch: pytest.MonkeyPatch, arguments: list[str], number: signal.Signals, status: int
) -> None:
    monkeypatch.setattr(sys, "argv", ["prostar-gateway", *arguments])
    with pytest.raises(SystemExit) as left:
        module._leave(number, None)
    assert left.value.code == status


def test_nothing_slow_is_imported_before_the_signals_are_handled() -> None:
    tree = ast.parse(Path(module.__file__).read_text())
    top = {
        alias.name if isinstance(node, ast.Import) else node.module
        for node in tree.body
        if isinstance(node, ast.Import | ast.ImportFrom)
        for alias in node.names
    }
    assert top <= {"__future__", "io", "os", "signal", "sys", "types"}


@pytest.mark.parametrize("closed", ["<&-", ">&-", "2>&-", "<&- >&- 2>&-"])
def test_a_gateway_whose_streams_are_closed_works(tmp_path: Path, closed: str) -> None:
    """Nothing of its own gets their numbers, for what is logged would go there."""
    config = tmp_path / "site.toml"
    config.write_text(SITE.format(folder=tmp_path))
    process = subprocess.Popen(["sh", "-c", f'exec "$@" {closed}', "sh", *GATEWAY, "run", "-c", str(config)])
    try:
        wait_until((tmp_path / "trace").exists, "the gateway")
        closed_ones = [number for number, sign in enumerate(("<&-", " >&-", "2>&-")) if sign in f" {closed}"]
        leading = [Path(f"/proc/{process.pid}/fd/{number}").readlink() for number in closed_ones]
        assert leading == [Path("/dev/null")] * len(closed_ones)
        process.terminate()
        assert process.wait(30) == 0
    finally:
        process.kill()
        process.wait()


@pytest.mark.parametrize(("command", "status"), [("check-config", 0), ("log --format csv", 1), ("writes", 0)])
def test_a_terminal_that_has_not_all_letters_is_no_matter(tmp_path: Path, command: str, status: int) -> None:
    config = tmp_path / "site.toml"
    config.write_text(SITE.format(folder=tmp_path).replace("/dev/ttyS0", "tcp://127.0.0.1:502"))
    words, variables = [*GATEWAY, *command.split(), "-c", str(config)], {**os.environ, "PYTHONIOENCODING": "ascii"}
    done = subprocess.run(words, capture_output=True, check=False, env=variables)
    assert (done.returncode, b"Traceback" in done.stderr) == (status, False)
