"""docs/faults.md names a test file for each row of the serial line's part of the failure catalogue."""

from __future__ import annotations

import re
from pathlib import Path

HERE = Path(__file__).parent
PAGE = HERE.parents[1] / "docs" / "faults.md"
ROWS = range(1, 25)


def test_every_row_has_a_file_and_every_file_is_named() -> None:
    files = {path.name for path in HERE.glob("test_f[0-9][0-9]_*.py")}
    rows = {int(name[6:8]) for name in files}
    assert rows >= set(ROWS)
    named = set(re.findall(r"\.\./tests/faults/(test_f\w+\.py)", PAGE.read_text()))
    assert named <= files
    assert {name for name in files if int(name[6:8]) in ROWS} <= named
