"""The use of a line over the last minute."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.core.usage import UseMeter


def test_half_busy_is_a_half() -> None:
    meter = UseMeter(1000.0)
    for second in range(120):
        meter.add(1000.0 + second, 1000.5 + second)
    assert meter.ratio(1120.0) == pytest.approx(0.5, abs=0.01)


def test_a_young_meter_counts_from_its_start() -> None:
    meter = UseMeter(10.0)
    meter.add(10.0, 12.0)
    assert meter.ratio(14.0) == pytest.approx(0.5)


def test_what_is_over_a_minute_old_is_forgotten() -> None:
    meter = UseMeter(0.0)
    meter.add(0.0, 30.0)
    assert meter.ratio(200.0) == 0.0


def test_nothing_was_measured_yet() -> None:
    assert UseMeter(5.0).ratio(5.0) == 0.0


@given(st.lists(st.tuples(st.floats(0, 90), st.floats(0, 90)), max_size=40), st.floats(0, 1e6))
def test_the_ratio_equals_a_plain_sum_over_the_window(steps: list[tuple[float, float]], start: float) -> None:
    meter, now, busy = UseMeter(start), start, []
    for idle_s, busy_s in steps:
        begin = now + idle_s
        now = begin + busy_s
        meter.add(begin, now)
        busy.append((begin, now))
    now += 0.25
    ratio = meter.ratio(now)
    since = max(start, int(now) - 59.0)
    expected = sum(max(0.0, end - max(begin, since)) for begin, end in busy) / (now - since)
    assert ratio == pytest.approx(min(1.0, expected), abs=1e-6)
