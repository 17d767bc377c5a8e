"""Libraries that the gateway is faster with and works without."""

from __future__ import annotations

import importlib
import os
from types import ModuleType

import pytest


def optional(name: str) -> ModuleType:
    """The library; without it the test is skipped, and fails when CI is set, for `make setup` installs it."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        if os.environ.get("CI"):
            pytest.fail(f"{error} (a failure because CI is set)")
        pytest.skip(str(error))
