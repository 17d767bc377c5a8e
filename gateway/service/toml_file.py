"""The configuration file as tables of TOML, before anybody looks at what is in them.

Nothing but the standard library is loaded for it: `health` needs no more.
"""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

from gateway.errors import ConfigError


def read_toml(path: Path) -> dict[str, Any]:
    """The tables of the file; ConfigError, beginning with its name, when it cannot be read or is no TOML in UTF-8."""
    try:
        text = path.read_bytes().decode("utf-8-sig")  # some editors put a mark in front
    except OSError as error:
        raise ConfigError((f"{path}: cannot be read: {error.strerror or error}",)) from None
    except UnicodeDecodeError as error:
        raise ConfigError((f"{path}: not UTF-8 at byte {error.start}; allowed: TOML in UTF-8",)) from None
    return parse_toml(text, str(path))


def parse_toml(text: str, source: str) -> dict[str, Any]:
    """The tables of the text; ConfigError, beginning with `source`, when it is no TOML."""
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:  # its text ends in "(at line 3, column 5)"
        raise ConfigError((f"{source}: not TOML: {error}",)) from None
    except (ValueError, RecursionError) as error:  # a number of thousands of digits, lists in lists without end
        raise ConfigError((f"{source}: not TOML that can be read: {error}",)) from None
