"""`run` without the command line: what it takes as plain, and what a gateway that works for years has loaded."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from gateway.cli import run as command
from gateway.cli.app import app
from gateway.cli.running import Arguments, plain_arguments
from gateway.service.logs import Level
from gateway.service.loops import Loop

NEVER = (
    "aiohttp",
    "click",
    "cryptography",
    "email",
    "http.client",
    "http.server",
    "prometheus_client",
    "pydantic",
    "pydantic_core",
    "pymodbus",
    "pysmi",
    "pysnmp.entity",
    "pysnmp.hlapi",
    "rich",
    "tomllib",
    "typer",
    "gateway.cli.app",
    "gateway.devices.forms",
    "gateway.generate",
    "gateway.service.schema",
    "gateway.simulator",
)
"""What a gateway without SNMPv3 and TLS has no use for; each is megabytes or a tenth of a second."""

CONFIG = """
site = "imports"
state_dir = "{folder}/state"
[[line]]
name = "shelter-a"
port = "{folder}/none"
[[line.device]]
name = "array-1"
address = 1
unit_id = 1
model = "prostar-mppt"
[modbus]
listen = ["127.0.0.1:0"]
[http]
listen = ["127.0.0.1:0"]
[snmp]
listen = ["127.0.0.1:0"]
[[snmp.community]]
name = "read"
source = ["127.0.0.0/8"]
"""


@pytest.mark.parametrize(
    "words",
    [
        ["-c", "x.toml"],
        ["--config", "x.toml"],
        ["--config=x=y.toml", "--loop", "asyncio"],
        ["--loop=asyncio", "-c", "x.toml", "--log-level", "debug"],
        ["-c", "x.toml", "-c", "y.toml"],
    ],
)
def test_plain_words_mean_what_they_mean_to_typer(monkeypatch: pytest.MonkeyPatch, words: list[str]) -> None:
    told: list[Arguments] = []
    monkeypatch.setattr(command, "run", told.append)
    assert CliRunner().invoke(app, ["run", *words]).exit_code == 0
    assert plain_arguments(words) == told[0]


def test_what_is_left_out_has_its_default() -> None:
    assert plain_arguments(["-c", "x"]) == Arguments(Path("x"), None, Loop.AUTO)
    assert plain_arguments(["-c", "x", "--log-level=error"]) == Arguments(Path("x"), Level.ERROR, Loop.AUTO)


@pytest.mark.parametrize(
    "words",
    [
        [],
        ["--help"],
        ["-c"],
        ["-c", ""],
        ["-c=x"],
        ["-cx"],
        ["-c", "x", "y"],
        ["-c", "x", "--help"],
        ["-c", "x", "--loop", "none"],
        ["-c", "x", "--log-level", "loud"],
        ["--loop", "asyncio"],
    ],
)
def test_everything_else_is_left_to_typer(words: list[str]) -> None:
    assert plain_arguments(words) is None


def test_a_loop_that_is_not_here_is_left_to_typer(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gateway.cli.running.find_spec", lambda _name: None)
    assert plain_arguments(["-c", "x", "--loop", "uvloop"]) is None


def test_a_running_gateway_has_loaded_only_what_it_uses(tmp_path: Path) -> None:
    path = tmp_path / "site.toml"
    path.write_text(CONFIG.format(folder=tmp_path))
    words = [sys.executable, "-X", "importtime", "-m", "gateway", "run", "-c", str(path)]
    with subprocess.Popen(words, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        loaded: set[str] = set()
        for line in process.stderr:
            if found := re.fullmatch(r"import time: +\d+ \| +\d+ \| +([\w.]+)\n", line):
                loaded.add(found[1])
            if 'event=listening listener="http' in line:
                process.send_signal(signal.SIGTERM)
    assert process.returncode == 0
    assert "gateway.service.process" in loaded
    assert [
        name for name in sorted(loaded) if name.startswith(tuple(f"{each}." for each in NEVER)) or name in NEVER
    ] == []
