"""The fenced code blocks of the README and the docs."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]


@dataclass(frozen=True, slots=True)
class Block:
    """One fenced block; `kind` is the first word behind its fence ("" is a shell block), `name` the rest."""

    page: str
    line: int
    kind: str
    name: str
    text: str

    def __str__(self) -> str:
        return f"{self.page}:{self.line}"

    def commands(self) -> list[str]:
        """The commands of a shell block: comments left out, continued lines joined."""
        joined = self.text.replace("\\\n", " ")
        return [line.strip() for line in joined.splitlines() if line.strip() and not line.lstrip().startswith("#")]


def pages() -> list[Path]:
    """Every page that a reader may follow."""
    found = [*ROOT.glob("*.md")]
    for folder in ("docs", "deploy", "mibs", "config"):
        found += (ROOT / folder).rglob("*.md")
    return sorted(found)


def blocks() -> Iterator[Block]:
    """All blocks of all pages, in order."""
    for page in pages():
        inside: list[str] | None = None
        kind, name, start = "", "", 0
        for number, line in enumerate(page.read_text(encoding="utf-8").splitlines(), 1):
            fence = re.match(r" *```(\w*) ?(.*)$", line)
            if fence is None:
                if inside is not None:
                    inside.append(line)
            elif inside is None:
                inside, kind, name, start = [], fence[1], fence[2], number
            else:
                assert not fence[1], f"{page}:{number}: a fence within a fence"
                yield Block(str(page.relative_to(ROOT)), start, kind, name, "\n".join(inside) + "\n")
                inside = None
        assert inside is None, f"{page}:{start}: a block without an end"
