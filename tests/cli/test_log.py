"""`prostar-gateway log`: what it prints of a history, and what it says when there is none."""

from __future__ import annotations

import csv
import io
import json
import os
import pty
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from gateway.cli import log
from gateway.cli.app import app
from gateway.history.store import Store
from tests.history.blocks import LAYOUT, block, full_ring, seen

HOURS = [1000 + 24 * day for day in range(30)]
REPOSITORY = Path(__file__).parents[2]
Run = Callable[..., Result]


@pytest.fixture
def config(tmp_path: Path) -> Path:
    """A configuration whose history has thirty days of array-1, the last with an alarm, and a block apart."""
    text = (REPOSITORY / "config" / "minimal.toml").read_text()
    path = tmp_path / "site.toml"
    path.write_text(f'state_dir = "{tmp_path / "state"}"\n{text}')
    ring = full_ring(HOURS) | {29: block(HOURS[29], alarms=1), 30: block(HOURS[29], low_v=11.0)}
    with closing(Store(tmp_path / "state", 1)) as store:
        store.keep_ring(seen(HOURS[-1] + 5), LAYOUT, ring)
    return path


@pytest.fixture
def run(config: Path) -> Run:
    def invoke(*arguments: str, env: dict[str, str] | None = None) -> Result:
        return CliRunner().invoke(app, ["log", "-c", str(config), *arguments], env={"COLUMNS": "120", **(env or {})})

    return invoke


@pytest.mark.parametrize("width", [80, 104, 200])
def test_the_table_has_dates_with_their_error(run: Run, width: int) -> None:
    result = run(env={"COLUMNS": str(width)})
    assert result.exit_code == 0
    hourmeter = rf"{HOURS[-1]} +" if width >= 104 else ""
    row = rf"^ ?2026-11-18 06:06 +1\.0 +{hourmeter}\d\d\.\d\d +14\.25 +60\.0 +55\.0 +70\.00 +2:30 +0:00 +1:30 *$"
    assert re.search(row, result.stdout, re.MULTILINE), result.stdout
    assert re.search(r"^  2026-11-18 06:06  alarms: \w+$", result.stdout, re.MULTILINE)
    assert "array-1 on shelter-a" in result.stdout
    assert ("Vb_min: battery voltage minimum" in " ".join(result.stdout.split())) is (width < 104)
    assert all(len(line) <= width for line in result.stdout.splitlines())
    assert "30 days of 1 controller; 1 block kept apart" in result.stdout
    assert f"array-1: block 30, hourmeter {HOURS[-1]} h, tie" in result.stdout


def test_a_selection_of_nothing_is_said(run: Run) -> None:
    result = run("--since", "2027-01-01")
    assert (result.exit_code, result.stdout.splitlines()[0]) == (0, "0 days of 0 controllers; 1 block kept apart")


@pytest.mark.parametrize("form", ["csv", "json", "jsonl", "openmetrics"])
def test_the_other_forms_are_the_exports(run: Run, form: str) -> None:
    result = run("--format", form, "--since", "2026-11-17T12:00", "--until", "2026-11-18")
    assert (result.exit_code, result.stderr) == (0, "")
    if form == "csv":
        hours = [int(row["hourmeter_hours"]) for row in csv.DictReader(io.StringIO(result.stdout))]
    elif form == "json":
        hours = [day["hourmeter_hours"] for day in json.loads(result.stdout)["days"]]
    elif form == "jsonl":
        hours = [json.loads(line)["hourmeter_hours"] for line in result.stdout.splitlines()]
    else:
        found = re.findall(r"^morningstar_hourmeter_daily_seconds{.*} (\d+) ", result.stdout, re.MULTILINE)
        hours = [int(seconds) // 3600 for seconds in found]
    assert hours == [HOURS[-1]]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--device", "nobody"), "there are: array-1"),
        (("--since", "soon"), "allowed: a date such as"),
        (("--format", "xml"), "'openmetrics'"),
    ],
)
def test_what_is_wrong_is_said_with_what_is_allowed(run: Run, arguments: tuple[str, ...], words: str) -> None:
    result = run(*arguments)
    assert result.exit_code == 2
    assert words in " ".join(re.sub("[│╭╮╰╯─]", " ", result.stderr).split())


def test_without_a_history_it_says_so(tmp_path: Path) -> None:
    path = tmp_path / "site.toml"
    text = (REPOSITORY / "config" / "minimal.toml").read_text()
    path.write_text(f'state_dir = "{tmp_path}"\n{text}')
    result = CliRunner().invoke(app, ["log", "-c", str(path)])
    assert (result.exit_code, result.stdout) == (1, "")
    assert "there is no history yet" in result.stderr


def test_days_without_a_date_are_counted_where_they_are_left_out(run: Run, tmp_path: Path) -> None:
    with closing(Store(tmp_path / "state", 2)) as store:
        store.keep_ring(seen(20, wall=1000.0), LAYOUT, {0: block(18)})
    assert "no date yet" in run().stdout
    result = run("--format", "openmetrics")
    assert result.stderr == "1 days have no date yet and were left out\n"


def test_a_closed_pipe_ends_it_quietly(config: Path) -> None:
    command = f"{sys.executable} -m gateway log -c {config} --format csv | true; exit ${{PIPESTATUS[0]}}"
    done = subprocess.run(["bash", "-c", command], cwd=REPOSITORY, capture_output=True, check=False)
    assert (done.returncode, done.stderr) == (0, b"")


@pytest.fixture
def terminal() -> Iterator[tuple[int, int]]:
    ends = pty.openpty()
    yield ends
    for fd in ends:
        os.close(fd)


@pytest.mark.parametrize(("after_s", "shown"), [(0.0, True), (60.0, False)])
def test_a_bar_is_shown_on_a_terminal_when_it_takes_long(
    terminal: tuple[int, int], monkeypatch: pytest.MonkeyPatch, after_s: float, shown: bool
) -> None:
    master, slave = terminal
    monkeypatch.setattr(log, "BAR_AFTER_S", after_s)
    monkeypatch.setenv("TERM", "xterm")
    written = b""
    with os.fdopen(os.dup(slave), "w") as stderr:
        monkeypatch.setattr(sys, "stderr", stderr)
        with log._bar(1000) as progress:
            progress(1)
            while shown and b"reading days" not in written:
                written += os.read(master, 65536)  # the test's time limit is the limit
    os.set_blocking(master, False)
    with suppress(BlockingIOError):
        written += os.read(master, 65536)
    assert (b"reading days" in written) is shown


def test_no_bar_without_a_terminal(capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(log, "BAR_AFTER_S", 0.0)
    with log._bar(10) as progress:
        progress(10)
    assert capfd.readouterr() == ("", "")


def test_the_history_is_not_part_of_the_metrics() -> None:
    page = (REPOSITORY / "docs" / "metrics.md").read_text()
    assert "_daily_" not in page
