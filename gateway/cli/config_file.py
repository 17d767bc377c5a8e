"""The option that names the configuration, and what every command does with a bad one."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, NoReturn

import typer

from gateway.cli.refusing import counted, refused
from gateway.errors import ConfigError
from gateway.service.config import Config, config_of, load_config
from gateway.service.toml_file import read_toml

ConfigOption = Annotated[Path, typer.Option("--config", "-c", metavar="FILE", help="The configuration file (TOML).")]

_STAND_IN: Mapping[str, object] = {
    "site": "unknown",
    "line": [
        {"name": "-", "port": "/dev/null", "device": [{"name": "-", "address": 1, "unit_id": 1, "model": "auto"}]}
    ],
}
"""A site in place of one that is not right."""


def load_or_exit(path: Path) -> Config:
    """The configuration; when it is bad, every problem on standard error and exit status 78."""
    try:
        return load_config(path)
    except ConfigError as error:
        refuse(path, error.problems)


def part_or_exit(path: Path, *keys: str) -> Config:
    """The configuration for a command that needs these top-level keys of it and nothing else.

    With problems elsewhere it is said that there are some, and the rest of what is given is a stand-in: whoever looks
    after a gateway that runs by the file of before, or makes a backup of one that does not start, must not be kept
    from it. A problem in one of the keys is as in `load_or_exit`, and so is a key that nobody knows: it may be one.
    """
    try:
        return load_config(path)
    except ConfigError as error:
        problems = error.problems
    try:
        raw = read_toml(path)
        part = config_of({**_STAND_IN, **{key: raw[key] for key in keys if key in raw}})
    except ConfigError:
        refuse(path, problems)
    if not raw.keys() <= Config.model_fields.keys():
        refuse(path, problems)
    print(f"note: check-config names {counted(problems)} in {path}; they do not matter here", file=sys.stderr)
    return part


def refuse(path: Path, problems: Sequence[str]) -> NoReturn:
    """Every problem on standard error, and exit status 78."""
    raise typer.Exit(refused(path, problems)) from None
