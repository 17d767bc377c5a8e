"""Problems of a configuration: where, what is wrong, what is allowed.

A problem reads `line[0].device[1].unit_id: 300 is out of range; allowed: 1 to 247`. They are reported in the
order of the file, each once.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

Path = tuple[str | int, ...]


@dataclass(frozen=True, slots=True)
class Problem:
    """One thing that is wrong."""

    path: Path
    text: str

    def __str__(self) -> str:
        return f"{render_path(self.path)}: {self.text}" if self.path else self.text


def render_path(path: Path) -> str:
    """The key path as people write it: list positions from 0 in brackets."""
    text = ""
    for part in path:
        text += f"[{part}]" if isinstance(part, int) else f".{part}" if text else part
    return text


def show(value: object) -> str:
    """A value of the file in at most 60 characters."""
    try:
        text = json.dumps(value, ensure_ascii=False)
    except (TypeError, ValueError):  # TOML has dates, JSON has not
        text = str(value)
    return text if len(text) <= 60 else f"{text[:57]}…"


def show_file(value: object) -> str:
    """The value of a key that names a file: what does not look like a path may be the secret itself."""
    looks_like_a_path = isinstance(value, str) and value.startswith("/") and value.isprintable()
    return show(value) if looks_like_a_path else "the value"


def in_file_order(problems: Iterable[Problem], raw: Mapping[str, object]) -> list[Problem]:
    """Sorted by where the keys stand in the file, each text once; what is missing comes last in its table."""
    return sorted(dict.fromkeys(problems), key=lambda problem: _rank(problem.path, raw))


def _rank(path: Path, raw: object) -> tuple[int, ...]:
    rank: list[int] = []
    for part in path:
        if isinstance(raw, Mapping):
            keys = list(raw)
            rank.append(keys.index(part) if part in keys else len(keys))
            raw = raw.get(part)
        elif isinstance(raw, list) and isinstance(part, int):
            rank.append(part)
            raw = raw[part] if 0 <= part < len(raw) else None
    return tuple(rank)
