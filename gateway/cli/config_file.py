"""The option that names the configuration, and what every command does with a bad one."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, NoReturn

import typer

from gateway.errors import ConfigError
from gateway.service.config import Config, load_config

EX_CONFIG = 78  # sysexits.h; systemd does not start again after it

ConfigOption = Annotated[Path, typer.Option("--config", "-c", metavar="FILE", help="The configuration file (TOML).")]


def load_or_exit(path: Path) -> Config:
    """The configuration; when it is bad, every problem on standard error and exit status 78."""
    try:
        return load_config(path)
    except ConfigError as error:
        refuse(path, error.problems)


def refuse(path: Path, problems: Sequence[str]) -> NoReturn:
    """Every problem on standard error, and exit status 78."""
    count = len(problems)
    for problem in problems:
        print(problem, file=sys.stderr)
    print(f"{count} problem{'s' * (count != 1)} in {path}", file=sys.stderr)
    raise typer.Exit(EX_CONFIG) from None
