"""As much of a YAML writer as generated files need: mappings, lists, texts and numbers in block style.

A text is quoted as JSON quotes it, which YAML reads alike; one of several lines is a literal block.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence

Node = str | int | float | bool | Mapping[str, "Node"] | Sequence["Node"]


def dump(node: Mapping[str, Node]) -> str:
    """The document of a mapping."""
    return "".join(f"{line}\n" for line in _mapping(node))


def _mapping(node: Mapping[str, Node]) -> Iterator[str]:
    for key, value in node.items():
        yield from _entry(f"{key}:", value)


def _sequence(node: Sequence[Node]) -> Iterator[str]:
    for item in node:
        if isinstance(item, Mapping):
            lines = list(_mapping(item))
            yield f"- {lines[0]}"
            yield from (f"  {line}" for line in lines[1:])
        else:
            yield from _entry("-", item)


def _entry(begin: str, value: Node) -> Iterator[str]:
    if isinstance(value, str) and "\n" in value:
        yield f"{begin} |2-"
        yield from (f"  {line}" if line else "" for line in value.splitlines())
    elif isinstance(value, Mapping) and value:
        yield begin
        yield from (f"  {line}" for line in _mapping(value))
    elif isinstance(value, Sequence) and not isinstance(value, str) and value:
        yield begin
        yield from (f"  {line}" for line in _sequence(value))
    else:
        yield f"{begin} {json.dumps(value, ensure_ascii=False)}"
