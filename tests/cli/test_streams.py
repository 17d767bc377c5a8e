"""Standard streams that are closed, full, or that nobody reads."""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path

import pytest

from gateway.history.store import Store
from tests.e2e.programs import GATEWAY, wait_until
from tests.history.blocks import LAYOUT, full_ring, seen

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


@pytest.fixture
def commands(tmp_path: Path) -> dict[str, list[str]]:
    """Commands with something to print, of a site with as long a history as a controller has."""
    with closing(Store(tmp_path, 1)) as store:
        store.keep_ring(seen(10_000), LAYOUT, full_ring([1000 + 24 * day for day in range(256)]))
    path = tmp_path / "site.toml"
    path.write_text(SITE.format(folder=tmp_path).replace("\u5c71-1", "array-1"))
    config = f"-c {path}"
    texts = (
        f"log {config}",
        f"log {config} --format csv",
        f"check-config {config}",
        f"backup {config} {tmp_path}/site.tar",
        "simulate --line a=1",
        "--help",
    )
    return {text.split()[0] + str(number): text.split() for number, text in enumerate(texts)}


def _ends(commands: Mapping[str, Sequence[str]], output: int) -> dict[str, tuple[int, str]]:
    """Exit status and standard error of the commands, which run at once, with this standard output."""
    variables = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    processes = {
        name: subprocess.Popen([*GATEWAY, *words], env=variables, stdout=output, stderr=subprocess.PIPE, text=True)
        for name, words in commands.items()
    }
    try:
        said = {name: process.communicate(timeout=60)[1] for name, process in processes.items()}
        return {name: (process.returncode, said[name]) for name, process in processes.items()}
    finally:
        for process in processes.values():
            process.kill()
            process.wait()


def test_a_full_disk_is_one_line_and_exit_status_1(commands: Mapping[str, Sequence[str]]) -> None:
    with Path("/dev/full").open("wb") as full:
        found = _ends(commands, full.fileno())
    assert found == dict.fromkeys(commands, (1, "standard output cannot be written: No space left on device\n"))


def test_a_reader_that_left_is_no_news(commands: Mapping[str, Sequence[str]]) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, "wb"):
        found = _ends(commands, writer)
    cut_off = 128 + signal.SIGPIPE
    statuses = {"log0": 0, "log1": 0, "check-config2": cut_off, "backup3": cut_off, "simulate4": 0, "--help5": cut_off}
    assert found == {name: (status, "") for name, status in statuses.items()}


def test_what_cannot_be_said_changes_no_exit_status(tmp_path: Path) -> None:
    with Path("/dev/full").open("wb") as full:
        done = subprocess.run([*GATEWAY, "run", "-c", str(tmp_path / "none.toml")], stderr=full, check=False)
    assert done.returncode == 78


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
