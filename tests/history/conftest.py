"""A history with two controllers, for everything that reads it."""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest

from gateway.history.dates import Look
from gateway.history.identity import Place
from gateway.history.store import Store
from tests.history.blocks import LAYOUT, block, full_ring, seen

HOURS = [1000 + 24 * day for day in range(100)]


@pytest.fixture
def history(tmp_path: Path) -> Path:
    """array-1: 100 days up to 5 h before WALL, alarms on two of them, a tie; another device: two days, no date."""
    ring = full_ring(HOURS)
    ring[97] = block(HOURS[97], alarms=0b101)
    ring[98] = block(HOURS[98], alarms=0x8000_0001, low_v=float("nan"))
    ring[100] = block(HOURS[99], low_v=11.0)
    directory = tmp_path / "state"
    with closing(Store(directory, session=1)) as store:
        store.keep_ring(seen(HOURS[-1] + 5), LAYOUT, ring)
        place = Place("shelter-b", 'the "second"', 12)
        young = replace(seen(90, place=place, serial="17340002"), look=Look(90, 1000.0))
        store.keep_ring(young, LAYOUT, {0: block(50), 1: block(74)})
    return directory
