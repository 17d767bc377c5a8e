"""Waiting that a signal ends.

A handler runs in the main thread, in the middle of whatever that was doing, and a second signal in the middle of
the first one's handler. So a handler takes no lock (`threading.Event.set` does, and two quick Ctrl-C hang it): it
writes one byte to a pipe.

Whoever started us may have had signals blocked, and we have that of him: those that are waited for are let through.
"""

from __future__ import annotations

import asyncio
import os
import select
import signal
from collections.abc import Iterable
from contextlib import suppress
from types import FrameType


class Stop:
    """Set by any of the signals, for good."""

    def __init__(self, signals: Iterable[signal.Signals]) -> None:
        self._read, self._write = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        numbers = tuple(signals)
        for number in numbers:
            signal.signal(number, self._on_signal)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, numbers)

    def _on_signal(self, _number: int, _frame: FrameType | None) -> None:
        with suppress(BlockingIOError):  # the pipe is full of earlier signals
            os.write(self._write, b".")

    def wait(self, timeout_s: float) -> bool:
        """Wait for a signal; whether one came, now or earlier."""
        return bool(select.select([self._read], [], [], timeout_s)[0])

    @property
    def is_set(self) -> bool:
        """Whether a signal came."""
        return self.wait(0.0)


def stop_event(signals: Iterable[signal.Signals]) -> asyncio.Event:
    """Set by the first of the signals; more of them are ignored from then on, until the interpreter has ended.

    A handler of the loop would not do: when that is closed the system has the signals again, and ends us by them.
    """
    numbers, loop, event = tuple(signals), asyncio.get_running_loop(), asyncio.Event()

    def on_signal(_number: int, _frame: FrameType | None) -> None:
        for number in numbers:
            signal.signal(number, signal.SIG_IGN)
        loop.call_soon_threadsafe(event.set)

    for number in numbers:
        signal.signal(number, on_signal)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, numbers)
    return event
