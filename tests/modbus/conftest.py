from __future__ import annotations

import pytest

from tests.modbus.virtual_line import Cut, VirtualLine


@pytest.fixture(params=list(Cut), ids=lambda cut: cut.value)
def line(request: pytest.FixtureRequest) -> VirtualLine:
    """A line with 9600 8N2, once for each way an adapter may cut what it hears."""
    return VirtualLine(request.param)
