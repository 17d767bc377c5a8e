"""Whatever a file holds, it is a configuration or a list of problems: never another exception, never an empty list."""

from __future__ import annotations

import copy
import datetime as dt
import tomllib
from pathlib import Path
from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from gateway.errors import ConfigError
from gateway.service.config import config_of

FULL = tomllib.loads((Path(__file__).parents[2] / "config" / "full.toml").read_text())

leaves = st.one_of(
    st.booleans(),
    st.integers(),
    st.floats(),
    st.text(max_size=20),
    st.sampled_from(
        ["127.0.0.1:1502", "[::]:1", "tcp://a", "socket://[", "rfc2217://h:99999", "auto", "1.3.6.1.4.1.33333"]
    ),
    st.just(dt.date(2026, 11, 22)),
)
values = st.recursive(
    leaves,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(min_size=1, max_size=8), inner, max_size=3),
    max_leaves=6,
)


def places(raw: Any) -> list[tuple[Any, Any]]:
    """Every (container, key) of the file."""
    found: list[tuple[Any, Any]] = []
    pairs = raw.items() if isinstance(raw, dict) else enumerate(raw) if isinstance(raw, list) else ()
    for key, value in pairs:
        found.append((raw, key))
        found += places(value)
    return found


def is_config_or_problems(raw: dict[str, Any]) -> None:
    problems: tuple[str, ...] | None = None
    try:
        config_of(raw, "c.toml")
    except ConfigError as error:
        problems = error.problems
    assert problems is None or problems
    assert problems is None or len(set(problems)) == len(problems)
    assert all(problem.startswith("c.toml: ") for problem in problems or ())


@given(st.data())
def test_a_right_file_with_anything_put_anywhere(data: st.DataObject) -> None:
    raw = copy.deepcopy(FULL)
    for _ in range(data.draw(st.integers(1, 3))):
        container, key = data.draw(st.sampled_from(places(raw)))
        container[key] = data.draw(values)
    is_config_or_problems(raw)


@given(st.dictionaries(st.sampled_from([*FULL, "snpm"]), values))
def test_anything_under_the_known_names(raw: dict[str, Any]) -> None:
    is_config_or_problems(raw)
