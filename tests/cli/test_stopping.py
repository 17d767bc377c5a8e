"""Waiting that signals end: any number of them, at any moment."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator

import pytest

from gateway.cli.stopping import Stop
from tests.machine import Bystander


@pytest.fixture
def stop() -> Iterator[Stop]:
    before = signal.getsignal(signal.SIGUSR1)
    yield Stop([signal.SIGUSR1])
    signal.signal(signal.SIGUSR1, before)


def test_without_a_signal_it_waits(stop: Stop) -> None:
    assert not stop.is_set
    assert not stop.wait(0.01)


def test_a_signal_ends_the_wait_for_good(stop: Stop) -> None:
    sender = threading.Timer(0.05, os.kill, (os.getpid(), signal.SIGUSR1))
    sender.start()
    with Bystander() as passing:
        assert stop.wait(30)
    assert passing.s < 5
    assert stop.wait(30)
    assert stop.is_set
    sender.join()


def test_a_signal_that_was_blocked_before_ends_the_wait() -> None:
    before = signal.getsignal(signal.SIGUSR1)
    blocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGUSR1})
    try:
        stop = Stop([signal.SIGUSR1])
        os.kill(os.getpid(), signal.SIGUSR1)
        assert stop.is_set
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, blocked)
        signal.signal(signal.SIGUSR1, before)


def test_more_signals_than_a_pipe_holds_change_nothing(stop: Stop) -> None:
    for _ in range(70_000):
        stop._on_signal(signal.SIGUSR1, None)
    assert stop.is_set
