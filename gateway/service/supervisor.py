"""Keeps lines, keepers and listeners going, each on its own.

Rule 1: one that fails never takes another with it. It is tried again after 0.5 s, 1 s, 2 s … at most 10 s.
Rule 2: an address that cannot be opened is an operating condition: one log line when it begins, one when its
reason changes or five minutes have passed, one when it is over.
Rule 3: a task that ends by an exception nobody expected is a bug: counted, logged with its traceback the first
time it looks like this, restarted all the same. A task that does so `FAILURES` times in `FAILURES_S` is beyond help
from here: `run` ends and `beyond_help` names it, so that the process can be started anew.
Rule 4: stopping is in order: listeners take nobody new, lines begin nothing more and answer 06 to what waits, the
transactions on the wire run to their end and are answered; then connections are closed, then the lines. What has
not stopped in time is left behind; the process ends.
Rule 5: `change` stops what is not wanted any more and starts what is new; what stays is not touched.
"""

from __future__ import annotations

import asyncio
import json
import logging
import traceback
from collections import Counter, defaultdict, deque
from collections.abc import Awaitable, Callable, Iterable, Iterator, Sequence

from gateway.clock import Clock
from gateway.errors import ListenError
from gateway.service.parts import Line, Listener, Runnable

FIRST_DELAY_S = 0.5
LAST_DELAY_S = 10.0
STEADY_S = 60.0  # what ran so long starts again with the first delay
FAILURES = 5
FAILURES_S = 60.0
REMIND_S = 300.0
STOP_LISTENERS_S = 4.5
STOP_LINES_S = 0.5

_log = logging.getLogger(__name__)
Task = asyncio.Task[None]


class Supervisor:
    """Runs lines, keepers and listeners until told to stop."""

    def __init__(
        self,
        clock: Clock,
        lines: Sequence[Line],
        listeners: Sequence[Listener],
        keepers: Sequence[Runnable] = (),
        *,
        sleep: Callable[[float], Awaitable[None]] = asyncio.sleep,
    ) -> None:
        self._clock = clock
        self._sleep = sleep
        self._lines: dict[Line, Task | None] = dict.fromkeys(lines)
        self._keepers: dict[Runnable, Task | None] = dict.fromkeys(keepers)
        self._listeners: dict[Listener, Task | None] = dict.fromkeys(listeners)
        self._up: set[Listener] = set()
        self._tried: set[Listener] = set()
        self._news = asyncio.Event()  # a listener was tried
        self._seen_bugs: set[str] = set()
        self._failures: defaultdict[str, deque[float]] = defaultdict(lambda: deque(maxlen=FAILURES))
        self._over = asyncio.Event()
        self.restarts: Counter[str] = Counter()  # task → how often a bug ended it
        self.beyond_help = ""  # the task that rule 3 gave up

    def down(self) -> tuple[str, ...]:
        """The labels of the listeners that are not open; none means ready, whatever lines and controllers do."""
        return tuple(listener.label for listener in self._listeners if listener not in self._up)

    def keep(self, keeper: Runnable) -> None:
        """Have one more keeper; before `run`."""
        self._keepers[keeper] = None

    async def settled(self) -> None:
        """Wait until every listener is open, or was tried."""
        while not self._tried >= self._listeners.keys():
            self._news.clear()
            await self._news.wait()

    def stuck(self, most_s: float) -> tuple[str, ...]:
        """What does not work although nothing from outside hinders it: its own task is gone, or `most_s` overdue."""
        now = self._clock.monotonic()
        tasks = (*self._lines.values(), *self._keepers.values(), *self._listeners.values())
        gone = [task.get_name() for task in tasks if task is not None and task.done()]
        late = [f"line {line.name}" for line in self._lines if line.overdue_s(now) > most_s]
        return (*gone, *late)

    async def run(self, stop: asyncio.Event) -> None:
        """Keep everything going until `stop` is set, then stop it in order; returns in at most about 5 s more."""
        self._start()
        told = asyncio.create_task(stop.wait())
        over = asyncio.create_task(self._over.wait())
        try:
            await asyncio.wait((told, over), return_when=asyncio.FIRST_COMPLETED)
        finally:
            told.cancel()
            over.cancel()
            self._over.set()  # a change that is under way starts nothing more
            lines, keepers, listeners = self._lines.values(), self._keepers.values(), self._listeners.values()
            await self._stop(tuple(self._lines), _tasks(lines), _tasks(keepers), _tasks(listeners))

    async def change(self, lines: Sequence[Line], listeners: Sequence[Listener], keepers: Sequence[Runnable]) -> None:
        """Have exactly these from now on (rule 5); one that comes can have the address or port of one that goes."""
        gone = [line for line in self._lines if line not in lines]
        running = _tasks(self._lines[line] for line in gone)
        keeping = _tasks(task for keeper, task in self._keepers.items() if keeper not in keepers)
        listening = _tasks(task for listener, task in self._listeners.items() if listener not in listeners)
        self._lines = {line: self._lines.get(line) for line in lines}
        self._keepers = {keeper: self._keepers.get(keeper) for keeper in keepers}
        self._listeners = {listener: self._listeners.get(listener) for listener in listeners}
        self._tried &= self._listeners.keys()
        await self._stop(gone, running, keeping, listening)
        if not self._over.is_set():
            self._start()

    def give_up(self, task: str) -> None:
        """End everything, for nothing but a new start helps."""
        if not self.beyond_help:
            self.beyond_help = task
            self._over.set()

    def _start(self) -> None:
        for line, task in self._lines.items():
            if task is None:
                name = f"line {line.name}"
                self._lines[line] = asyncio.create_task(self._keep_running(name, line), name=name)
        for keeper, task in self._keepers.items():
            if task is None:
                self._keepers[keeper] = asyncio.create_task(self._keep_running(keeper.name, keeper), name=keeper.name)
        for listener, task in self._listeners.items():
            if task is None:
                self._listeners[listener] = asyncio.create_task(self._keep_listener(listener), name=listener.label)

    async def _stop(
        self, lines: Sequence[Line], running: Sequence[Task], keeping: Sequence[Task], listening: Sequence[Task]
    ) -> None:
        """Rule 4, for the tasks of these lines, of keepers and of listeners."""
        until = asyncio.get_running_loop().time() + STOP_LISTENERS_S
        for task in listening:
            task.cancel()
        finishing = [asyncio.create_task(line.finish(), name=f"line {line.name}") for line in lines]
        await self._ended(listening, STOP_LISTENERS_S)
        await self._ended(finishing, until - asyncio.get_running_loop().time())
        for task in (*finishing, *running, *keeping):
            task.cancel()
        await self._ended((*running, *keeping), STOP_LINES_S)

    async def _ended(self, tasks: Sequence[Task], timeout_s: float) -> None:
        if not tasks:
            return
        ended, late = await asyncio.wait(tasks, timeout=max(0.0, timeout_s))
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

    async def _keep_listener(self, listener: Listener) -> None:
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
            self._was_tried(listener)
            await self._sleep(next(delays))
        self._up.add(listener)
        self._was_tried(listener)
        try:
            await asyncio.Event().wait()
        finally:
            self._up.discard(listener)
            # In a task of its own: in one that was cancelled, asyncio.timeout of Python 3.11.2 takes its end for that.
            await asyncio.create_task(listener.stop(), name=f"{listener.label} stops")

    def _was_tried(self, listener: Listener) -> None:
        self._tried.add(listener)
        self._news.set()

    def _bug(self, task: str, error: Exception) -> None:
        """Rule 3."""
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
        now = self._clock.monotonic()
        failures = self._failures[task]
        failures.append(now)
        if len(failures) == FAILURES and now - failures[0] <= FAILURES_S and not self.beyond_help:
            _log.critical('event=giving_up task="%s" failures=%d within_s=%.0f', task, FAILURES, now - failures[0])
            self.give_up(task)


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


def _tasks(tasks: Iterable[Task | None]) -> list[Task]:
    return [task for task in tasks if task is not None]
