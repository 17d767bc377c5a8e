"""A device map as JSON: written when derived files are made, read by every gateway that starts.

Rule 1: what is read back equals what was written, types and all; a file whose fields are not exactly those of model.py
        is not read. So neither another TOML nor another version of the classes is ever taken for the present one.
Rule 2: fields with their default are left out. Texts are shared between maps.
"""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Callable, Mapping
from dataclasses import MISSING, Field, fields, is_dataclass
from enum import Enum
from functools import cache
from types import MappingProxyType, NoneType, UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

from gateway.devices.model import DeviceMap

Restore = Callable[..., Any]


def digest_of(text: str) -> str:
    """What tells one TOML text from another."""
    return hashlib.sha256(text.encode()).hexdigest()


def compiled(device_map: DeviceMap, text: str) -> str:
    """The map that was made of the TOML `text`."""
    document = {"made_of": digest_of(text), "fields": _all_fields(), "map": _plain(device_map)}
    return json.dumps(document, ensure_ascii=False, indent=1) + "\n"


def restored(written: str, digest: str) -> DeviceMap | None:
    """The map, or None when it was made of another text or by other classes; ValueError when it is none at all."""
    document = json.loads(written)
    if not isinstance(document, dict):
        raise ValueError("no map")  # noqa: TRY004 - of what is read, not of a type
    if document.get("made_of") != digest or document.get("fields") != _all_fields():
        return None
    try:
        found = _restore(DeviceMap)(document["map"])
    except (KeyError, TypeError, AttributeError) as error:
        raise ValueError("no map") from error
    assert isinstance(found, DeviceMap)
    return found


def _plain(value: object) -> object:
    """The value in JSON's types."""
    if is_dataclass(value) and not isinstance(value, type):
        kept = {field.name: getattr(value, field.name) for field in fields(value)}
        defaults = {field.name: field.default for field in fields(value) if field.default is not MISSING}
        return {name: _plain(each) for name, each in kept.items() if name not in defaults or each != defaults[name]}
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, Mapping):
        return [[_plain(key), _plain(each)] for key, each in value.items()]
    if isinstance(value, frozenset):
        return sorted(value)
    if isinstance(value, tuple):
        return [_plain(each) for each in value]
    return value


@cache
def _restore(hint: Any) -> Restore:  # noqa: PLR0911 - one way back for each kind of type
    """What makes a value of this type out of what `_plain` made of it."""
    if hint is str:
        return sys.intern
    if hint in {int, float, bool} or (isinstance(hint, type) and issubclass(hint, Enum)):
        kind: Restore = hint
        return kind
    origin, parts = get_origin(hint), get_args(hint)
    if origin in {Union, UnionType} and set(parts) == {int, float}:
        return lambda value: value
    if origin in {Union, UnionType}:
        (present,) = (part for part in parts if part is not NoneType)
        one = _restore(present)
        return lambda value: None if value is None else one(value)
    if origin is tuple and parts[-1] is Ellipsis:
        each = _restore(parts[0])
        return lambda value: tuple(map(each, value))
    if origin is tuple:
        places = tuple(map(_restore, parts))
        return lambda value: tuple(place(part) for place, part in zip(places, value, strict=True))
    if origin is frozenset:
        return frozenset
    if origin is Mapping:
        key, of = map(_restore, parts)
        return lambda value: MappingProxyType({key(name): of(part) for name, part in value})
    make: Restore = hint
    known = {name: _restore(of) for name, of in get_type_hints(hint).items()}
    return lambda value: make(**{name: known[name](part) for name, part in value.items()})


@cache
def _all_fields() -> str:
    """What model.py's classes look like: their names, fields, types and defaults."""
    seen: dict[str, list[str]] = {}
    _look(DeviceMap, seen)
    return hashlib.sha256(json.dumps(seen, sort_keys=True).encode()).hexdigest()


def _look(hint: Any, seen: dict[str, list[str]]) -> None:
    if isinstance(hint, type) and is_dataclass(hint) and hint.__name__ not in seen:
        seen[hint.__name__] = [f"{field.name}: {field.type}{_default(field)}" for field in fields(hint)]
        for of in get_type_hints(hint).values():
            _look(of, seen)
    elif isinstance(hint, type) and issubclass(hint, Enum):
        seen[hint.__name__] = [each.value for each in hint]
    for part in get_args(hint):
        _look(part, seen)


def _default(field: Field[Any]) -> str:
    return "" if field.default is MISSING else f" = {field.default!r}"
