"""Supervision: failures stay alone, are retried with back-off, said once; stopping is in order."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager

import pytest

from gateway.errors import ListenError
from gateway.service import supervisor as module
from gateway.service.supervisor import Supervisor


class Time:
    """Time that passes only in `sleep`."""

    def __init__(self) -> None:
        self.now = 100.0
        self.slept: list[float] = []

    def monotonic(self) -> float:
        return self.now

    def wall(self) -> float:
        return self.now

    async def sleep(self, seconds: float) -> None:
        self.slept.append(seconds)
        self.now += seconds
        await asyncio.sleep(0)


class FakeLine:
    name = "a"

    def __init__(self, time: Time, failures: int, runs_s: float = 0.0) -> None:
        self.time, self.failures, self.runs_s = time, failures, runs_s
        self.running = asyncio.Event()
        self.finished = False
        self.cancelled = False
        self.late_s = 0.0

    def overdue_s(self, now: float) -> float:
        return self.late_s

    async def finish(self) -> None:
        self.finished = True

    async def run(self) -> None:
        if self.failures:
            self.failures -= 1
            self.time.now += self.runs_s
            raise ZeroDivisionError("a bug")
        self.running.set()
        try:
            await asyncio.Event().wait()
        finally:
            self.cancelled = True


class FakeListener:
    def __init__(self, label: str, errors: list[Exception] | None = None) -> None:
        self.label = label
        self.errors = errors or []
        self.bound: tuple[str, int] | None = None
        self.started = asyncio.Event()
        self.on_start: Callable[[], None] = lambda: None
        self.on_stop: Callable[[], None] = lambda: None

    async def start(self) -> None:
        if self.errors:
            raise self.errors.pop(0)
        self.on_start()
        self.bound = ("127.0.0.1", 1)
        self.started.set()

    async def stop(self) -> None:
        self.bound = None
        self.on_stop()


@asynccontextmanager
async def running(supervisor: Supervisor) -> AsyncIterator[asyncio.Event]:
    stop = asyncio.Event()
    task = asyncio.create_task(supervisor.run(stop))
    try:
        yield stop
    finally:
        stop.set()
        await task


async def test_a_taken_address_is_said_once_and_tried_until_it_opens(caplog: pytest.LogCaptureFixture) -> None:
    time = Time()
    taken = FakeListener("modbus 127.0.0.1:1502", [ListenError("modbus 127.0.0.1:1502: taken")] * 8)
    other = FakeListener("http 127.0.0.1:9850")
    supervisor = Supervisor(time, [], [taken, other], sleep=time.sleep)
    async with running(supervisor):
        await other.started.wait()
        assert supervisor.down() == ("modbus 127.0.0.1:1502",)
        await taken.started.wait()
        await asyncio.sleep(0)
        assert supervisor.down() == ()
    assert time.slept == [0.5, 1.0, 2.0, 4.0, 8.0, 10.0, 10.0, 10.0]
    failed = [record for record in caplog.records if "listen_failed" in record.message]
    assert [record.getMessage() for record in failed] == [
        'event=listen_failed listener="modbus 127.0.0.1:1502" error="modbus 127.0.0.1:1502: taken" tries=1 next=retry'
    ]
    over = [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]
    assert over == ['event=listening listener="modbus 127.0.0.1:1502" address=127.0.0.1:1 after_s=45.5']


async def test_a_changed_reason_is_said_again(caplog: pytest.LogCaptureFixture) -> None:
    time = Time()
    listener = FakeListener("x", [ListenError("one"), ListenError("one"), ListenError("two")])
    async with running(Supervisor(time, [], [listener], sleep=time.sleep)):
        await listener.started.wait()
    said = [record.getMessage() for record in caplog.records if "listen_failed" in record.message]
    assert [text.partition("error=")[2] for text in said] == ['"one" tries=1 next=retry', '"two" tries=3 next=retry']


async def test_a_bug_restarts_its_task_and_shows_its_traceback_once(caplog: pytest.LogCaptureFixture) -> None:
    time = Time()
    line, other = FakeLine(time, 3), FakeLine(time, 0)
    other.name = "b"
    supervisor = Supervisor(time, [line, other], [], sleep=time.sleep)
    async with running(supervisor):
        await line.running.wait()
        assert supervisor.restarts == {"line a": 3}
        assert other.running.is_set()
    failed = [record for record in caplog.records if "task_failed" in record.message]
    assert [record.exc_info is not None for record in failed] == [True, False, False]
    assert (
        failed[0].getMessage() == """event=task_failed task="line a" restarts=1 error="ZeroDivisionError('a bug')\""""
    )
    assert time.slept == [0.5, 1.0, 2.0]


async def test_a_line_that_ran_for_long_starts_again_quickly() -> None:
    time = Time()
    line = FakeLine(time, 3, runs_s=module.STEADY_S + 1)
    async with running(Supervisor(time, [line], [], sleep=time.sleep)):
        await line.running.wait()
    assert time.slept == [0.5, 0.5, 0.5]


async def test_a_keeper_is_restarted_like_a_line_under_its_own_name() -> None:
    time = Time()
    line, keeper = FakeLine(time, 1), FakeLine(time, 2)
    supervisor = Supervisor(time, [line], [], [keeper], sleep=time.sleep)
    async with running(supervisor):
        await line.running.wait()
        await keeper.running.wait()
    assert supervisor.restarts == {f"line {line.name}": 1, keeper.name: 2}
    assert keeper.cancelled


async def test_a_bug_in_a_listener_is_counted_and_retried() -> None:
    time = Time()
    listener = FakeListener("x", [ZeroDivisionError()])
    supervisor = Supervisor(time, [], [listener], sleep=time.sleep)
    async with running(supervisor):
        await listener.started.wait()
    assert supervisor.restarts == {"x": 1}


async def test_listeners_stop_while_the_lines_still_run() -> None:
    time = Time()
    line, listener = FakeLine(time, 0), FakeListener("x")
    seen: list[bool] = []
    listener.on_stop = lambda: seen.append(line.cancelled)
    async with running(Supervisor(time, [line], [listener], sleep=time.sleep)) as stop:
        await line.running.wait()
        await listener.started.wait()
        await asyncio.sleep(0)
        stop.set()
    assert seen == [False]
    assert line.finished
    assert line.cancelled


async def test_five_failures_in_a_minute_are_beyond_help(caplog: pytest.LogCaptureFixture) -> None:
    time = Time()
    line, listener = FakeLine(time, 99), FakeListener("x")
    supervisor = Supervisor(time, [line], [listener], sleep=time.sleep)
    await supervisor.run(asyncio.Event())  # nobody stops it
    assert supervisor.beyond_help == "line a"
    told = [
        record.message.split()[0]
        for record in caplog.records
        if "task_failed" in record.message or "giving_up" in record.message
    ]
    assert told[:6] == ["event=task_failed"] * 5 + ["event=giving_up"]
    assert listener.bound is None  # it stopped in order all the same
    assert [record.levelno for record in caplog.records if "giving_up" in record.message] == [logging.CRITICAL]


async def test_failures_that_are_far_apart_are_not() -> None:
    time = Time()
    line = FakeLine(time, 9, runs_s=module.FAILURES_S / 4)
    supervisor = Supervisor(time, [line], [], sleep=time.sleep)
    async with running(supervisor):
        await line.running.wait()
    assert supervisor.beyond_help == ""


async def test_failures_of_different_tasks_are_not_added_up() -> None:
    time = Time()
    line, listener = FakeLine(time, 4), FakeListener("x", [ZeroDivisionError()] * 4)
    supervisor = Supervisor(time, [line], [listener], sleep=time.sleep)
    async with running(supervisor):
        await line.running.wait()
        await listener.started.wait()
    assert supervisor.beyond_help == ""


async def test_it_is_settled_when_every_listener_was_tried() -> None:
    time = Time()
    taken, other = FakeListener("x", [ListenError("taken")] * 100), FakeListener("y")
    supervisor = Supervisor(time, [], [taken, other], sleep=time.sleep)
    async with running(supervisor):
        await supervisor.settled()
        assert other.bound is not None
        assert supervisor.down() == ("x",)


async def test_a_line_that_is_overdue_and_a_task_that_is_gone_are_stuck() -> None:
    time = Time()
    line = FakeLine(time, 0)
    supervisor = Supervisor(time, [line], [FakeListener("x")], sleep=time.sleep)
    async with running(supervisor):
        await line.running.wait()
        assert supervisor.stuck(10.0) == ()
        line.late_s = 10.5
        assert supervisor.stuck(10.0) == ("line a",)
        line.late_s = 0.0
        gone = next(task for task in asyncio.all_tasks() if task.get_name() == "x")
        gone.cancel()  # nobody does that: it stands for a mistake of the supervisor's own
        await asyncio.wait({gone})
        assert supervisor.stuck(10.0) == ("x",)


async def test_a_change_stops_what_goes_starts_what_comes_and_leaves_the_rest() -> None:
    time = Time()
    kept, gone, new = FakeLine(time, 0), FakeLine(time, 0), FakeLine(time, 0)
    stays, leaves, comes = FakeListener("stays"), FakeListener("leaves"), FakeListener("comes")
    stays.on_stop = lambda: pytest.fail("touched") if not stopping else None
    stopping = False
    went: list[tuple[bool, bool, object]] = []
    supervisor = Supervisor(time, [kept, gone], [stays, leaves], sleep=time.sleep)
    async with running(supervisor):
        await supervisor.settled()
        await gone.running.wait()
        comes.on_start = lambda: went.append((gone.finished, gone.cancelled, leaves.bound))
        await supervisor.change([new, kept], [stays, comes], [])
        await supervisor.settled()
        await new.running.wait()
        assert went == [(True, True, None)]  # all that goes had gone
        assert (kept.finished, kept.cancelled) == (False, False)
        assert supervisor.down() == ()
        stopping = True
    assert kept.cancelled
    assert new.cancelled
    assert comes.bound is None


async def test_what_does_not_stop_is_left_behind(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(module, "STOP_LISTENERS_S", 0.01)
    release = asyncio.Event()

    class Stubborn(FakeListener):
        async def stop(self) -> None:
            await release.wait()

    stubborn = Stubborn("x")
    supervisor = Supervisor(Time(), [], [stubborn])
    async with running(supervisor):
        await stubborn.started.wait()
        await asyncio.sleep(0)
    assert "event=stop_late" in caplog.text
    release.set()
    await asyncio.sleep(0)


async def test_a_listener_stops_in_a_task_that_nobody_cancelled() -> None:
    """In one that was, asyncio.timeout of Python 3.11.2 never ends in time: nobody was told that it is over."""
    cancelled: list[int] = []

    class Asking(FakeListener):
        async def stop(self) -> None:
            task = asyncio.current_task()
            assert task is not None
            cancelled.append(task.cancelling())

    listener = Asking("x")
    async with running(Supervisor(Time(), [], [listener])):
        await listener.started.wait()
        await asyncio.sleep(0)
    assert cancelled == [0]


async def test_a_stop_that_fails_is_logged_and_nothing_else(caplog: pytest.LogCaptureFixture) -> None:
    def fail() -> None:
        raise ZeroDivisionError

    listener = FakeListener("x")
    listener.on_stop = fail
    async with running(Supervisor(Time(), [], [listener])):
        await listener.started.wait()
        await asyncio.sleep(0)
    assert "event=stop_failed" in caplog.text
