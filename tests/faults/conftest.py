"""Fixtures of the fault tests. Each rig that a test makes is accounted for at its end."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from gateway.simulator.medium import Medium
from tests.faults.rig import MakeRig, Rig, Unit, make_rig


@pytest.fixture
def rig() -> Iterator[MakeRig]:
    """Make a rig (rig.py); after the test all its transactions are accounted for and its values judged once more."""
    made: list[Rig] = []

    def make(*units: Unit, medium: Medium | None = None, **options: Any) -> Rig:
        made.append(make_rig(*units, medium=medium, **options))
        return made[-1]

    yield make
    for one in made:
        one.account()
