"""A secret typed where the name of its file belongs is in no message, whichever key it is."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any, get_args

import pytest

from gateway.errors import ConfigError
from gateway.service.config import config_of, parse_config
from gateway.service.schema import Config, Table
from gateway.service.snmp import snmp_settings, unreadable
from tests.service.test_config import MINIMAL

SECRET = "correct-horse-7"
USER = """
[[snmp.user]]
name = "noc"
auth_password_file = "{auth}"
priv_password_file = "{priv}"
"""
Path = tuple[tuple[str, bool], ...]
"""Names of keys, and whether a list of tables stands there."""


def file_keys(table: type[Table], path: Path = ()) -> Iterator[Path]:
    """Every key that names a file: by its name, or because a path is allowed."""
    for name, field in table.model_fields.items():
        inner = [field.annotation]
        tables = []
        while inner:
            kind = inner.pop()
            if isinstance(kind, type) and issubclass(kind, Table):
                tables.append(kind)
            inner.extend(get_args(kind))
        for each in tables:
            yield from file_keys(each, (*path, (name, "tuple" in str(field.annotation))))
        allowed = "".join(str(getattr(data, "allowed", "")) for data in field.metadata)
        if name.endswith("_file") or "path of a file" in allowed or "PEM file" in allowed:
            yield (*path, (name, False))


KEYS = sorted(file_keys(Config))


def problems(path: Path, value: object) -> str:
    raw: Any = value
    for name, is_list in reversed(path):
        raw = {name: [raw] if is_list else raw}
    try:
        config_of(raw)
    except ConfigError as error:
        return "\n".join(error.problems)
    raise AssertionError("the rest is missing")


def test_all_of_them_are_found() -> None:
    names = {".".join(name for name, _ in path) for path in KEYS}
    assert {
        "snmp.user.auth_password_file",
        "snmp.user.priv_password_file",
        "http.basic_auth_file",
        "http.bearer_token_file",
        "http.tls_private_key",
        "modbus.tls.key_file",
    } <= names


@pytest.mark.parametrize("path", KEYS, ids=lambda path: ".".join(name for name, _ in path))
@pytest.mark.parametrize(
    "value",
    [
        f"{SECRET} battery",
        SECRET,
        f"ops:{SECRET}",
        f"-----BEGIN PRIVATE KEY-----\n{SECRET}\n",
        f"/\n{SECRET}",
        [SECRET],
        {"is": SECRET},
        70707070707,
    ],
    ids=json.dumps,
)
def test_no_problem_shows_what_is_no_path(path: Path, value: object) -> None:
    found = problems(path, value)
    assert SECRET not in found
    assert "70707070707" not in found


@pytest.mark.parametrize(
    "path",
    [(("snmp", False),), (("http", False),), (("modbus", False), ("tls", False))]
    + [(("snmp", False), (name, is_list)) for name in ("community", "user", "notify") for is_list in (False, True)],
    ids=lambda path: ".".join(name + "[]" * is_list for name, is_list in path),
)
@pytest.mark.parametrize("value", [SECRET, [SECRET], {"name": SECRET, "source": ["127.0.0.1"]}], ids=json.dumps)
def test_no_problem_shows_what_stands_in_the_place_of_a_table_with_secrets(path: Path, value: object) -> None:
    """Such as `community = "…"` below `[snmp]`, and `[snmp.community]` for `[[snmp.community]]`."""
    assert SECRET not in problems(path, value)


def test_what_stands_in_the_place_of_another_table_is_shown() -> None:
    assert '{"live_s": 1.0} is not a list' in problems((("line", False),), {"live_s": 1.0})


def test_a_path_is_shown() -> None:
    (user,) = [path for path in KEYS if path[-1][0] == "key_file"]
    assert "/etc/keys/server.key" not in problems(user, "/etc/keys/server.key"), "it is right"
    config = parse_config(MINIMAL + USER.format(auth="/nowhere/noc.auth", priv="/nowhere/noc.priv"))
    assert [text.split(": ")[1] for text in unreadable(config)] == [
        "/nowhere/noc.auth cannot be read",
        "/nowhere/noc.priv cannot be read",
    ]


def test_what_looks_like_the_name_of_a_credential_is_not_shown() -> None:
    config = parse_config(MINIMAL + USER.format(auth=SECRET, priv=f"{SECRET}-2"))
    assert list(unreadable(config)) == [
        f"snmp.user[0].{key}: the systemd credential of this name cannot be read: No such file or directory"
        for key in ("auth_password_file", "priv_password_file")
    ]
    with pytest.raises(ConfigError) as caught:
        snmp_settings(config)
    assert SECRET not in str(caught.value)
    assert SECRET not in repr(config)
