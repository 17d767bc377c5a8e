"""The clocks of the tests themselves."""

from __future__ import annotations

import time

from tests.machine import TICK_S, Bystander


def test_a_bystander_counts_what_passes() -> None:
    began = time.monotonic()
    with Bystander() as passing:
        while passing.s < 5 * TICK_S:
            assert time.monotonic() - began < 60.0
            time.sleep(TICK_S)
    assert 5 * TICK_S <= passing.s <= time.monotonic() - began


def test_a_bystander_does_not_count_what_nobody_had() -> None:
    times = iter([100.0, 100.02, 100.05, 190.0, 190.01])
    passing = Bystander(lambda: next(times))
    passing.before = next(times)  # without the thread, whose looks would come in between
    for _ in range(4):
        passing.look()
    assert abs(passing.s - (0.02 + 0.03 + 0.04 + 0.01)) < 1e-9
