"""What a lock file names."""

from __future__ import annotations

import re
from pathlib import Path


def normal(name: str) -> str:
    """A package's name as the index compares it."""
    return re.sub(r"[-_.]+", "-", name).lower()


def locked(path: Path) -> dict[str, str]:
    """Package → version of a lock file."""
    found = re.finditer(r"^([\w.-]+)==(\S+)", path.read_text(encoding="utf-8"), re.MULTILINE)
    return {normal(each[1]): each[2] for each in found}
