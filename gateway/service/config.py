"""From the file to a `Config`: everything that is wrong is told at once.

What is allowed is in service/schema.py and service/crosscheck.py; how it is said, in service/problems.py.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from pydantic import ValidationError

from gateway.errors import ConfigError
from gateway.service.crosscheck import cross_problems
from gateway.service.plain import plain
from gateway.service.problems import in_file_order
from gateway.service.schema import Config
from gateway.service.schema_problems import from_pydantic
from gateway.service.toml_file import parse_toml, read_toml

__all__ = ["Config", "config_of", "load_config", "parse_config"]


def load_config(path: Path) -> Config:
    """The configuration in the file; ConfigError with all problems, each beginning with the file's name."""
    return config_of(read_toml(path), str(path))


def parse_config(text: str, source: str = "config") -> Config:
    """The configuration in the TOML text; ConfigError with all problems, each beginning with `source`."""
    return config_of(parse_toml(text, source), source)


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
