"""What the schema finds wrong, in the words of problems.py."""

from __future__ import annotations

import difflib
import ipaddress
import re
from collections.abc import Iterable
from typing import get_args

from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails

from gateway.service.keys import NETWORKS
from gateway.service.problems import Path, Problem, show, show_file
from gateway.service.schema import Config, Key, Table

_WRONG_TYPE = {
    "int_type": "is not a whole number",
    "float_type": "is not a number",
    "string_type": "is not a text",
    "bool_type": "is not true or false",
    "tuple_type": "is not a list",
    "dict_type": "is not a table",
    "model_type": "is not a table",
    "finite_number": "is not a finite number",
}
_NAMES_A_FILE = re.compile(r"_file$|^tls_")
_ABOVE_ALL = ("site", "state_dir")
"""The keys of no table: in TOML what is written below a table belongs to it."""
_OUT_OF_RANGE = ("greater_than_equal", "less_than_equal", "greater_than", "less_than")


def table_at(path: Path) -> type[BaseModel] | None:
    """The schema class of the table at `path`, or None where there is none (a value, a `decode` table)."""
    table: type[BaseModel] | None = Config
    for part in path:
        if isinstance(part, int):
            continue
        field = table.model_fields.get(part) if table else None
        table = _table_of(field) if field else None
    return table


def key_at(path: Path) -> Key | None:
    """What the schema says of the key at `path`; of the key that holds it when `path` points into a list or dict."""
    names = [part for part in path if isinstance(part, str)]
    table: type[BaseModel] | None = Config
    found: Key | None = None
    for name in names:
        field = table.model_fields.get(name) if table else None
        if field is None:
            break
        found = next((data for data in field.metadata if isinstance(data, Key)), None)
        table = _table_of(field)
    return found


def from_pydantic(errors: Iterable[ErrorDetails]) -> list[Problem]:
    """The problems that validation by the schema found."""
    # A list whose every item is wrong is also said to be too short; the items are what is wrong.
    return [
        Problem(error["loc"], _text(error)) for error in errors if error["type"] != "too_short" or not error["input"]
    ]


def _text(error: ErrorDetails) -> str:
    path, kind, value = error["loc"], error["type"], error["input"]
    if kind == "extra_forbidden":
        return _unknown(path)
    key = key_at(path)
    hint = _network_meant(key, value) if kind == "value_error" else ""
    allowed = f"; {hint}allowed: {key.allowed}" if key else ""
    if kind == "missing":
        return f"is missing{allowed}"
    name = next((part for part in reversed(path) if isinstance(part, str)), "")
    secret = (key and key.secret) or _holds_secrets(table_at(path))
    shown = "the value" if secret else show_file(value) if _NAMES_A_FILE.search(name) else show(value)
    if kind == "too_short":
        return f"is empty{allowed}"
    if kind in _OUT_OF_RANGE:
        return f"{shown} is out of range{allowed}"
    return f"{shown} {_WRONG_TYPE.get(kind, 'is not allowed')}{allowed}"


def _network_meant(key: Key | None, value: object) -> str:
    """A hint at the network that an address with a length is in, which many write for it."""
    if key is None or not key.allowed.startswith(NETWORKS) or not isinstance(value, str):
        return ""
    try:
        return f'did you mean "{ipaddress.ip_network(value, strict=False)}"? '
    except ValueError:
        return ""


def _unknown(path: Path) -> str:
    table = table_at(path[:-1])
    keys = tuple(table.model_fields) if table else ()
    near = difflib.get_close_matches(str(path[-1]), keys, n=1)
    hint = f'did you mean "{near[0]}"? ' if near else ""
    if len(path) > 1 and not near and path[-1] in _ABOVE_ALL:
        hint = "it stands above the first [table]; "
    return f"unknown key; {hint}allowed: {', '.join(keys)}"


def _holds_secrets(table: type[BaseModel] | None) -> bool:
    """Whether there are secrets, or names of files with some, in the table: what stands in its place may be one."""
    for name, field in table.model_fields.items() if table else ():
        key = next((data for data in field.metadata if isinstance(data, Key)), None)
        if (key and key.secret) or _NAMES_A_FILE.search(name) or _holds_secrets(_table_of(field)):
            return True
    return False


def _table_of(field: FieldInfo) -> type[BaseModel] | None:
    pending: list[object] = [field.annotation]
    while pending:
        kind = pending.pop()
        if isinstance(kind, type) and issubclass(kind, Table):
            return kind
        pending.extend(get_args(kind))
    return None
