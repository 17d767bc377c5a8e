"""What differs between two configurations, by key path. Values are never shown: some are secret."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

from gateway.service.plain import as_mapping

if TYPE_CHECKING:  # what it is at run time, plain.py says
    from gateway.service.schema import Config

NEEDS_RESTART = ("state_dir",)
"""Keys that a running gateway goes on with as it was started: what is open there is not moved."""

NAMED = ("line", "device")
"""Tables that are known by their names; those of others may be secret (a community's is)."""


def changes(old: Config, new: Config) -> tuple[str, ...]:
    """The keys whose values differ, with their paths; lines and devices are compared by name, other tables by place."""
    return tuple(_differences("", as_mapping(old), as_mapping(new)))


def _differences(path: str, old: object, new: object) -> Iterator[str]:
    if isinstance(old, Mapping) and isinstance(new, Mapping):
        for key in dict.fromkeys((*old, *new)):
            yield from _differences(f"{path}.{key}" if path else str(key), old.get(key), new.get(key))
    elif (tables := _tables(old, new, named=path.endswith(NAMED))) is not None:
        before, after = tables
        for key in dict.fromkeys((*before, *after)):
            yield from _differences(f"{path}[{key}]", before.get(key), after.get(key))
    elif old != new:
        yield path


def _tables(old: object, new: object, *, named: bool) -> tuple[dict[str, object], dict[str, object]] | None:
    """Two arrays of tables by their names, or by their places; None for anything else."""
    if not (isinstance(old, tuple | list) and isinstance(new, tuple | list)):
        return None
    both = (*old, *new)
    if not both or not all(isinstance(table, Mapping) for table in both):
        return None
    before = {table["name"] if named else str(place): table for place, table in enumerate(old)}
    after = {table["name"] if named else str(place): table for place, table in enumerate(new)}
    return before, after
