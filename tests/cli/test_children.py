"""Child processes end with their parent, also those that do not want to."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import pytest

from gateway.cli import children as module
from gateway.cli.children import last_lines, start_gateway_command, stop_all

STUBBORN = "import signal; signal.signal(signal.SIGTERM, signal.SIG_IGN); print(1, flush=True); signal.pause()"


def test_what_ignores_sigterm_is_killed_in_the_time_of_all(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "STOP_S", 0.2)
    children = [subprocess.Popen([sys.executable, "-c", STUBBORN], stdout=subprocess.PIPE) for _ in range(3)]
    for child in children:
        assert child.stdout is not None
        child.stdout.readline()
        child.stdout.close()
    began = time.monotonic()
    stop_all(children)
    assert time.monotonic() - began < 3
    assert [child.returncode for child in children] == [-9, -9, -9]


def test_what_it_says_goes_to_its_log(tmp_path: Path) -> None:
    path = tmp_path / "log"
    with path.open("wb") as log:
        child = start_gateway_command(["check-config", "-c", str(tmp_path / "none.toml")], log)
    assert child.wait(timeout=30) == 78
    stop_all([child])
    assert last_lines(path, 1) == [f"1 problem in {tmp_path / 'none.toml'}"]
