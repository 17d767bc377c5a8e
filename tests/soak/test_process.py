"""The leak rule itself: it sees a leak, and takes no jump for one."""

from __future__ import annotations

import os
import random

import pytest

from tests.soak.process import Held, growth_kib


def samples(*rss_kib: float) -> list[Held]:
    return [Held(5.0 * number, int(each), 9, 1) for number, each in enumerate(rss_kib)]


def test_a_leak_is_seen_through_noise() -> None:
    noise = random.Random(1)
    assert growth_kib(samples(*(50_000 + 40 * n + noise.uniform(-200, 200) for n in range(36)))) > 1000


def test_one_jump_and_a_saw_are_no_leak() -> None:
    assert growth_kib(samples(*(50_000 + 3000 * (n > 30) for n in range(36)))) == 0
    assert abs(growth_kib(samples(*(50_000 + 300 * (n % 4) for n in range(36))))) < 100


def test_few_samples_tell_nothing() -> None:
    with pytest.raises(AssertionError):
        growth_kib(samples(*(50_000 for _ in range(19))))


def test_what_this_process_holds() -> None:
    before = Held.of("self")
    read, write = os.pipe()
    try:
        assert Held.of(os.getpid()).descriptors == before.descriptors + 2
    finally:
        os.close(read)
        os.close(write)
    assert before.rss_kib > 10_000
    assert before.threads >= 1
