"""A configuration that was checked, without the library that checked it.

The gateway reads its configuration in a process of its own (reading.py) and holds it for years; only the former needs
the classes of schema.py and what they are made of. So a configuration, once it is right, is a tree of plain tables: the
same keys as attributes, the same values, equal when those are. Everybody who is given a `Config` by config.py has such
tables, and annotates the classes of schema.py, so that the type checker knows the keys.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar, cast

if TYPE_CHECKING:
    from gateway.service.schema import Config

T = TypeVar("T")

_TABLE, _MAPPING = "table", "mapping"


class PlainTable:
    """A table: its keys are attributes, and nothing can be changed."""

    def __init__(self, values: Mapping[str, object]) -> None:
        self.__dict__.update(values)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, PlainTable) and self.__dict__ == other.__dict__

    def __hash__(self) -> int:
        return hash(frozenset(self.__dict__))

    def __setattr__(self, name: str, value: object) -> NoReturn:
        raise AttributeError(f"a configuration is not changed: {name}")

    def __repr__(self) -> str:
        return f"PlainTable({', '.join(self.__dict__)})"  # some values are secret


def plain(config: Config) -> Config:
    """The same configuration in plain tables."""
    return cast("Config", _plain(config))


def _plain(value: object) -> object:
    names = getattr(type(value), "model_fields", None)
    if names is not None:
        return PlainTable({name: _plain(getattr(value, name)) for name in names})
    return tuple(map(_plain, value)) if isinstance(value, tuple) else value


def with_values(table: T, values: Mapping[str, object]) -> T:
    """The table with these values for these keys."""
    unknown = values.keys() - vars(table).keys()
    if unknown:
        raise KeyError(*unknown)
    return cast("T", PlainTable(vars(table) | dict(values)))


def as_mapping(value: object) -> Any:
    """The table, and all tables in it, as mappings."""
    if isinstance(value, PlainTable):
        return {name: as_mapping(each) for name, each in vars(value).items()}
    return tuple(map(as_mapping, value)) if isinstance(value, tuple) else value


def to_json(value: object) -> object:
    """The table in JSON's types; `from_json` has it back."""
    if isinstance(value, PlainTable):
        return {_TABLE: {name: to_json(each) for name, each in vars(value).items()}}
    if isinstance(value, Mapping):
        return {_MAPPING: {str(key): to_json(each) for key, each in value.items()}}
    return list(_each(value)) if isinstance(value, tuple) else value


def _each(values: tuple[object, ...]) -> Iterator[object]:
    return map(to_json, values)


def from_json(value: object) -> object:
    """What `to_json` was given."""
    if isinstance(value, list):
        return tuple(map(from_json, value))
    if not isinstance(value, Mapping):
        return value
    ((kind, held),) = value.items()
    values = {name: from_json(each) for name, each in held.items()}
    return PlainTable(values) if kind == _TABLE else values
