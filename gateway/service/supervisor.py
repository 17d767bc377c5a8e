"""Keeps lines and listeners going, each on its own.

Rule 1: one that fails never takes another with it. It is tried again after 0.5 s, 1 s, 2 s … at most 10 s.
Rule 2: an address that cannot be opened is an operating condition: one log line when it begins, one when its
reason changes or five minutes have passed, one when it is over.
Rule 3: a task that ends by an exception nobody expected is a bug: counted, logged with its traceback the first
time it looks like this, restarted all the same.
Rule 4: stopping is in order: listeners first, so that requests under way get their answers from lines that still
run, then the lines. What has not stopped in time is left behind; the process ends.
"""

from __future__ import annotations

import asyncio
import json
import logging
import traceback
from collections import Counter
from collections.abc import Awaitable, Callable, Iterator, Sequence
from typing import Protocol

from gateway.clock import Clock
from gateway.errors import ListenError

FIRST_DELAY_S = 0.5
LAST_DELAY_S = 10.0
STEADY_S = 60.0  # what ran so long starts again with the first delay
REMIND_S = 300.0
STOP_LISTENERS_S = 1.5
STOP_LINES_S = 1.0

_log = logging.getLogger(__name__)


class Runnable(Protocol):
    """A line or the history: runs until it is cancelled, and opens and reopens what it needs by itself."""

    @property
    def name(self) -> str:
        """What the log calls its task; of a line the configured name."""
        ...

    async def run(self) -> None:
        """Work until cancelled."""
        ...


class Listener(Protocol):
    """One address of a face."""

    @property
    def label(self) -> str:
        """Face and address, such as "modbus 127.0.0.1:1502"."""
        ...

    @property
    def bound(self) -> tuple[str, int] | None:
        """The real address while it listens."""
        ...

    async def start(self) -> None:
        """Open the address; ListenError when it cannot be opened. May be tried again."""
        ...

    async def stop(self) -> None:
        """Close it and what came in by it."""
        ...


class Supervisor:
    """Runs lines and listeners until told to stop."""

    def __init__(
        self,
        clock: Clock,
        lines: Sequence[Runnable],
        listeners: Sequence[Listener],
        keepers: Sequence[Runnable] = (),
        *,
        sleep: Callable[[float], Awaitable[None]] = asyncio.sleep,
    ) -> None:
        self._clock = clock
        self._lines = tuple(lines)
        self._keepers = tuple(keepers)
        self._listeners = tuple(listeners)
        self._sleep = sleep
        self._up: set[int] = set()
        self._seen_bugs: set[str] = set()
        self.restarts: Counter[str] = Counter()  # task → how often a bug ended it

    def down(self) -> tuple[str, ...]:
        """The labels of the listeners that are not open; none means ready, whatever lines and controllers do."""
        return tuple(listener.label for i, listener in enumerate(self._listeners) if i not in self._up)

    async def run(self, stop: asyncio.Event) -> None:
        """Keep everything going until `stop` is set, then stop it in order; returns in at most about 2.5 s more."""
        named = [(f"line {line.name}", line) for line in self._lines]
        named += [(keeper.name, keeper) for keeper in self._keepers]
        lines = [asyncio.create_task(self._keep_running(name, runnable), name=name) for name, runnable in named]
        listeners = [
            asyncio.create_task(self._keep_listener(i, listener), name=listener.label)
            for i, listener in enumerate(self._listeners)
        ]
        try:
            await stop.wait()
        finally:
            await self._end(listeners, STOP_LISTENERS_S)
            await self._end(lines, STOP_LINES_S)

    async def _end(self, tasks: Sequence[asyncio.Task[None]], timeout_s: float) -> None:
        for task in tasks:
            task.cancel()
        if not tasks:
            return
        ended, late = await asyncio.wait(tasks, timeout=timeout_s)
        for task in ended:
            error = None if task.cancelled() else task.exception()
            if error is not None:
                _log.error(
                    'event=stop_failed task="%s" error=%s', task.get_name(), json.dumps(repr(error)), exc_info=error
                )
        for task in late:
            _log.warning('event=stop_late task="%s" waited_s=%.1f', task.get_name(), timeout_s)

    async def _keep_running(self, name: str, runnable: Runnable) -> None:
        delays = _delays()
        while True:
            began = self._clock.monotonic()
            try:
                await runnable.run()
            except Exception as error:  # noqa: BLE001 - the task supervisor's edge: counted and logged there
                self._bug(name, error)
            else:
                self._bug(name, RuntimeError("the task returned"))
            if self._clock.monotonic() - began > STEADY_S:
                delays = _delays()
            await self._sleep(next(delays))

    async def _keep_listener(self, number: int, listener: Listener) -> None:
        delays = _delays()
        trouble = _Trouble(listener.label, self._clock)
        while True:
            try:
                await listener.start()
            except ListenError as error:
                trouble.failed(str(error))
            except Exception as error:  # noqa: BLE001 - the task supervisor's edge: counted and logged there
                self._bug(listener.label, error)
            else:
                trouble.over(listener.bound)
                break
            await self._sleep(next(delays))
        self._up.add(number)
        try:
            await asyncio.Event().wait()
        finally:
            self._up.discard(number)
            await listener.stop()

    def _bug(self, task: str, error: Exception) -> None:
        self.restarts[task] += 1
        frames = "".join(traceback.format_tb(error.__traceback__))
        first = f"{task}\n{type(error)}\n{frames}" not in self._seen_bugs
        self._seen_bugs.add(f"{task}\n{type(error)}\n{frames}")
        _log.error(
            'event=task_failed task="%s" restarts=%d error=%s',
            task,
            self.restarts[task],
            json.dumps(repr(error)),
            exc_info=error if first else None,
        )


class _Trouble:
    """What is said about a listener that cannot be opened, and when."""

    def __init__(self, label: str, clock: Clock) -> None:
        self._label = label
        self._clock = clock
        self._since: float | None = None
        self._said_at = 0.0
        self._said = ""
        self._tries = 0

    def failed(self, reason: str) -> None:
        now = self._clock.monotonic()
        self._tries += 1
        if self._since is None:
            self._since = now
        if reason != self._said or now - self._said_at >= REMIND_S:
            self._said, self._said_at = reason, now
            _log.error(
                'event=listen_failed listener="%s" error=%s tries=%d next=retry',
                self._label,
                json.dumps(reason),
                self._tries,
            )

    def over(self, bound: tuple[str, int] | None) -> None:
        address = "?" if bound is None else f"{bound[0]}:{bound[1]}"
        if self._since is None:
            _log.info('event=listening listener="%s" address=%s', self._label, address)
            return
        down_s = self._clock.monotonic() - self._since
        _log.warning('event=listening listener="%s" address=%s after_s=%.1f', self._label, address, down_s)


def _delays() -> Iterator[float]:
    delay = FIRST_DELAY_S
    while True:
        yield delay
        delay = min(LAST_DELAY_S, delay * 2)
