"""Every row of the failure catalogue has a file called by its number, and docs/faults.md names those of the line."""

from __future__ import annotations

import re
from pathlib import Path

HERE = Path(__file__).parent
PAGE = HERE.parents[1] / "docs" / "faults.md"
ROWS = range(1, 25)
ALL_ROWS = range(1, 90)
ELSEWHERE = {
    84: "characterisation/test_pymodbus.py",  # what a library does, on the locked and on the newest versions
    86: "soak/test_churn.py",
}
"""Rows whose tests are no faults that are injected."""


def test_every_row_has_a_file_with_tests() -> None:
    files = {int(path.name[6:8]): path for path in HERE.rglob("test_f[0-9][0-9]_*.py")}
    files |= {row: HERE.parent / name for row, name in ELSEWHERE.items()}
    assert sorted(files) == list(ALL_ROWS)
    assert all(re.search(r"^(async )?def test_", path.read_text(), re.MULTILINE) for path in files.values())


def test_every_row_has_a_file_and_every_file_is_named() -> None:
    files = {path.name for path in HERE.glob("test_f[0-9][0-9]_*.py")}
    rows = {int(name[6:8]) for name in files}
    assert rows >= set(ROWS)
    named = set(re.findall(r"\.\./tests/faults/(test_f\w+\.py)", PAGE.read_text()))
    assert named <= files
    assert {name for name in files if int(name[6:8]) in ROWS} <= named
