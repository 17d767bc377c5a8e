"""From the file to a `Config`: everything that is wrong is told at once.

What is allowed is in service/schema.py and service/crosscheck.py; how it is said, in service/problems.py.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path

from pydantic import ValidationError

from gateway.errors import ConfigError
from gateway.service.crosscheck import cross_problems
from gateway.service.plain import plain
from gateway.service.problems import in_file_order
from gateway.service.schema import Config
from gateway.service.schema_problems import from_pydantic

__all__ = ["Config", "config_of", "load_config", "parse_config"]


def load_config(path: Path) -> Config:
    """The configuration in the file; ConfigError with all problems, each beginning with the file's name."""
    return parse_config(file_text(path), source=str(path))


def file_text(path: Path) -> str:
    """What is in the file, without the mark that some editors put in front of UTF-8; ConfigError as `load_config`."""
    try:
        return path.read_bytes().decode("utf-8-sig")
    except OSError as error:
        raise ConfigError((f"{path}: cannot be read: {error.strerror or error}",)) from None
    except UnicodeDecodeError as error:
        raise ConfigError((f"{path}: not UTF-8 at byte {error.start}; allowed: TOML in UTF-8",)) from None


def parse_config(text: str, source: str = "config") -> Config:
    """The configuration in the TOML text; ConfigError with all problems, each beginning with `source`."""
    try:
        raw = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:  # its text ends in "(at line 3, column 5)"
        raise ConfigError((f"{source}: not TOML: {error}",)) from None
    except (ValueError, RecursionError) as error:  # a number of thousands of digits, lists in lists without end
        raise ConfigError((f"{source}: not TOML that can be read: {error}",)) from None
    return config_of(raw, source)


def config_of(raw: Mapping[str, object], source: str = "config") -> Config:
    """The configuration in parsed TOML, whatever that holds; ConfigError as `parse_config`.

    Its tables are those of plain.py.
    """
    config: Config | None = None
    problems = cross_problems(raw)
    try:
        config = Config.model_validate(raw)
    except ValidationError as error:
        problems += from_pydantic(error.errors(include_url=False, include_context=False))
    if config is None or problems:
        raise ConfigError(tuple(f"{source}: {problem}" for problem in in_file_order(problems, raw)))
    return plain(config)
