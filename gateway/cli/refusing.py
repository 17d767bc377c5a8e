"""What every command does with a bad configuration."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

EX_CONFIG = 78  # sysexits.h; systemd does not start again after it


def refused(path: Path, problems: Sequence[str]) -> int:
    """Every problem on standard error; the exit status."""
    for problem in problems:
        print(problem, file=sys.stderr)
    print(f"{counted(problems)} in {path}", file=sys.stderr)
    return EX_CONFIG


def counted(problems: Sequence[str]) -> str:
    """How many there are, in words."""
    return f"{len(problems)} problem{'s' * (len(problems) != 1)}"
