"""The breaker of one device: quarantine after three misses, probes 5 → 60 s with jitter."""

from __future__ import annotations

from random import Random

import pytest

from gateway.core.health import FIRST_PROBE_S, JITTER, LAST_PROBE_S, Breaker


def opened(now: float = 0.0) -> Breaker:
    breaker = Breaker(Random(1))
    for _ in range(3):
        breaker.missed(now)
    return breaker


def test_two_misses_do_not_open_it() -> None:
    breaker = Breaker(Random(1))
    breaker.missed(0.0)
    breaker.missed(1.0)
    assert not breaker.is_open


def test_a_reply_between_misses_starts_the_count_anew() -> None:
    breaker = Breaker(Random(1))
    for now in (0.0, 1.0):
        breaker.missed(now)
    breaker.replied()
    breaker.missed(2.0)
    breaker.missed(3.0)
    assert not breaker.is_open


def test_three_misses_open_it_and_the_first_probe_is_due_in_about_five_seconds() -> None:
    breaker = opened(now=100.0)
    assert breaker.is_open
    assert breaker.probe_at is not None
    assert 100.0 + FIRST_PROBE_S * (1 - JITTER) <= breaker.probe_at <= 100.0 + FIRST_PROBE_S


def test_probes_back_off_to_a_minute_and_no_further() -> None:
    breaker = opened()
    now, waits = 0.0, []
    for _ in range(8):
        assert breaker.probe_at is not None
        waits.append(breaker.probe_at - now)
        now = breaker.probe_at
        breaker.missed(now)
    for wait_s, full_s in zip(waits, (5, 10, 20, 40, 60, 60, 60, 60), strict=True):
        assert full_s * (1 - JITTER) <= wait_s <= full_s
    assert max(waits) <= LAST_PROBE_S


def test_jitter_keeps_the_probes_of_two_devices_apart() -> None:
    rng = Random(7)
    breakers = [Breaker(rng), Breaker(rng)]
    for breaker in breakers:
        for _ in range(3):
            breaker.missed(0.0)
    assert breakers[0].probe_at != breakers[1].probe_at


def test_one_reply_closes_it_and_resets_the_back_off() -> None:
    breaker = opened()
    for now in (5.0, 15.0, 35.0):
        breaker.missed(now)
    breaker.replied()
    assert not breaker.is_open
    for _ in range(3):
        breaker.missed(100.0)
    assert breaker.probe_at == pytest.approx(100.0 + FIRST_PROBE_S, abs=FIRST_PROBE_S * JITTER)


def test_an_opened_line_probes_at_once_and_starts_the_back_off_anew() -> None:
    breaker = opened()
    breaker.missed(5.0)
    breaker.line_opened(50.0)
    assert breaker.probe_at == 50.0
    healthy = Breaker(Random(1))
    healthy.line_opened(50.0)
    assert not healthy.is_open
