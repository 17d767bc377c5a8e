"""The page about all this names files that exist, and its snippets are what their programs accept."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.deploy.nms.conftest import NMS

TEXT = (NMS / "README.md").read_text(encoding="utf-8")


def test_every_file_is_on_the_page_and_every_row_is_a_file() -> None:
    rows = re.findall(r"^\| `([\w./-]+)` \|", TEXT, re.MULTILINE)
    assert len(rows) > 4
    assert all((NMS / row).exists() for row in rows)
    files = [path.relative_to(NMS) for path in NMS.rglob("*") if path.is_file() and path.name != "README.md"]
    assert [file for file in files if not any(str(file).startswith(row) for row in rows)] == []


def test_what_is_to_be_copied_is_there() -> None:
    for path in re.findall(r"^- `(librenms/\S+)` to", TEXT, re.MULTILINE):
        assert (NMS / path).is_file()


@pytest.mark.peer
def test_prometheus_accepts_the_scrape_configuration(peer: Callable[[str], str], tmp_path: Path) -> None:
    (snippet,) = re.findall(r"```yaml\n(scrape_configs:.*?)```", TEXT, re.DOTALL)
    (tmp_path / "prometheus.yml").write_text(snippet, encoding="utf-8")
    done = subprocess.run(
        [peer("promtool"), "check", "config", str(tmp_path / "prometheus.yml")],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr


def test_no_delivered_file_holds_a_credential() -> None:
    for path in NMS.rglob("*"):
        if path.is_file():
            text = path.read_text(encoding="utf-8")
            for word in re.findall(r"(?:community|password)\"?:? *=? *\"([^\"]+)\"", text):
                assert word.startswith("CHANGE-"), path
            assert not re.search(r"\b(public|private)\b", text) or path.suffix == ".md", path
