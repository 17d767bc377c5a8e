"""Token buckets: nobody gets more than its rate, and nobody who keeps to it is refused."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.core.ratelimit import (
    CLIENT_LINE,
    PAUSE_LEAST_S,
    PAUSE_MOST_S,
    Bucket,
    LineLimiter,
    LineRates,
)
from gateway.core.site import Device
from gateway.devices.schema import load_map

MAP = load_map("prostar-mppt")
RATES = st.floats(0.1, 10_000)
STEPS = st.lists(st.tuples(st.floats(0, 5), st.integers(1, 50)), max_size=60)


@given(per_s=RATES, burst_s=st.floats(0.1, 10), steps=STEPS)
def test_no_stretch_of_time_gives_more_than_burst_and_rate(
    per_s: float, burst_s: float, steps: list[tuple[float, int]]
) -> None:
    bucket = Bucket(per_s, burst_s, 0.0)
    now, taken = 0.0, [(0.0, 0)]
    for wait_s, most in steps:
        now += wait_s
        count = bucket.take(now, most)
        assert 0 <= count <= most
        taken.append((now, count))
    for start in range(len(taken)):
        for end in range(start, len(taken)):
            total = sum(count for _, count in taken[start + 1 : end + 1])
            span = taken[end][0] - taken[start][0]
            assert total <= max(1.0, per_s * burst_s) + per_s * span + 1e-6 * (1 + total)


@given(per_s=RATES, count=st.integers(1, 200))
def test_who_keeps_to_the_rate_is_never_refused(per_s: float, count: int) -> None:
    bucket = Bucket(per_s, 1.0, 0.0)
    assert all(bucket.take(at * 1.000001 / per_s) for at in range(count))


@given(per_s=RATES, tries=st.integers(1, 500))
def test_refusals_cost_nothing(per_s: float, tries: int) -> None:
    bucket = Bucket(per_s, 1.0, 0.0)
    bucket.take(0.0, 1_000_000)
    for _ in range(tries):
        assert not bucket.take(0.0)
    assert bucket.take(1.001 / per_s) == 1


@given(steps=STEPS)
def test_a_rate_of_0_is_no_limit(steps: list[tuple[float, int]]) -> None:
    bucket = Bucket(0.0, 2.0, 0.0)
    assert all(bucket.take(at, most) == most for at, most in steps)


def test_a_step_back_of_time_gives_nothing() -> None:
    bucket = Bucket(10.0, 1.0, 100.0)
    assert bucket.take(100.0, 10) == 10
    assert bucket.take(50.0) == 0
    assert bucket.take(100.15) == 1


@given(per_s=RATES, burst_s=st.floats(0.1, 10))
def test_a_pause_is_bounded_and_ends_with_a_token_where_that_is_possible(per_s: float, burst_s: float) -> None:
    bucket = Bucket(per_s, burst_s, 0.0)
    bucket.take(0.0, 1_000_000)
    pause_s = bucket.pause_s(0.0)
    assert PAUSE_LEAST_S <= pause_s <= PAUSE_MOST_S
    if pause_s < PAUSE_MOST_S:
        assert bucket.take(pause_s * 1.000001)


@pytest.fixture
def devices() -> list[Device]:
    """Units 1 and 2 on one line, 3 on another."""
    out = []
    for unit, name in ((1, "a"), (2, "a"), (3, "b")):
        device = Device(f"array-{unit}", unit, unit, MAP)
        device.line = NamedLine(name)  # type: ignore[assignment]  # the limiter wants the name only
        out.append(device)
    return out


class NamedLine:
    def __init__(self, name: str) -> None:
        self.name = name


def bucket(tokens: int) -> Bucket:
    return Bucket(1.0, float(tokens), 0.0)


def test_the_line_needs_a_token_of_each(devices: list[Device]) -> None:
    limiter = LineLimiter(LineRates(device_per_s=2.0, line_per_s=3.0), 1.0, devices)
    client = bucket(100)
    assert [limiter.take(client, devices[0], 0.0) for _ in range(3)] == [None, None, "device"]
    assert [limiter.take(client, devices[1], 0.0) for _ in range(2)] == [None, "line"]
    assert limiter.take(client, devices[2], 0.0) is None, "another line has its own"
    assert limiter.take(bucket(1), devices[2], 0.0) is None
    poor = bucket(1)
    assert poor.take(0.0) == 1
    assert limiter.take(poor, devices[2], 0.0) == CLIENT_LINE


def test_a_refused_request_takes_nothing_from_anybody(devices: list[Device]) -> None:
    limiter = LineLimiter(LineRates(device_per_s=1.0, line_per_s=2.0), 1.0, devices)
    client = bucket(2)
    assert limiter.take(client, devices[0], 0.0) is None
    for _ in range(5):
        assert limiter.take(client, devices[0], 0.0) == "device"
    assert limiter.take(client, devices[1], 0.0) is None, "the client's and the line's second tokens are still there"
