"""Markdown pieces shared by the generated pages.

A page is a list of blocks (paragraphs, headings, tables); `page` joins them with one empty line and a last newline.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence


def generated_mark(source: str) -> str:
    """The first lines of every generated page: where to change what it says."""
    return f"<!-- Made by `prostar-gateway generate` from {source}. Do not edit. -->"


def page(blocks: Iterable[str]) -> str:
    """Join blocks to a page."""
    return "\n\n".join(block.strip("\n") for block in blocks) + "\n"


def table(headings: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table; cells are escaped, so that `|` and line ends cannot break it."""
    lines = [_row(headings), _row(["---"] * len(headings))]
    lines += [_row([_cell(cell) for cell in row]) for row in rows]
    return "\n".join(lines)


def code(text: str) -> str:
    """`text` in code type; empty stays empty."""
    return f"`{text}`" if text else ""


def bullets(items: Iterable[str]) -> str:
    """A list, one item a line."""
    return "\n".join(f"- {item}" for item in items)


def _row(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |".replace("|  |", "| |").replace("|  |", "| |")


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")
