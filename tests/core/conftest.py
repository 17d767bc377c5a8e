"""Fixtures of the core tests."""

from __future__ import annotations

import pytest

from tests.core.virtual_line import MakeLine, make_line


@pytest.fixture
def virtual_line() -> MakeLine:
    """Make an opened virtual line with these stations; the settings may be changed by keyword."""
    return make_line
