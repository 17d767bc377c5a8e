"""Child processes end within their time, however many of them do not want to."""

from __future__ import annotations

import subprocess
import sys

import pytest

from gateway.cli import children as module
from gateway.cli.children import STOP_S, stop_all

STUBBORN = """
import signal, sys
signal.signal(signal.SIGTERM, signal.SIG_IGN)
print("up", flush=True)
sys.stdin.read()
"""


def stubborn() -> subprocess.Popen[bytes]:
    child = subprocess.Popen([sys.executable, "-c", STUBBORN], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert child.stdout is not None
    assert child.stdout.readline() == b"up\n"
    return child


class Deaf:
    """A child that only SIGKILL ends, and the clock that waiting for it moves."""

    now = 0.0

    def __init__(self) -> None:
        self.told: list[str] = []

    @classmethod
    def monotonic(cls) -> float:
        return cls.now

    def poll(self) -> None:
        return None

    def terminate(self) -> None:
        self.told.append("terminate")

    def kill(self) -> None:
        self.told.append("kill")

    def wait(self, timeout: float | None = None) -> int:
        if self.told == ["terminate"]:
            assert timeout is not None
            Deaf.now += timeout
            raise subprocess.TimeoutExpired("deaf", timeout)
        assert self.told == ["terminate", "kill"]
        return -9


def test_all_children_together_have_the_time_of_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """Which is below the two seconds that the demo has to end in."""
    monkeypatch.setattr(module, "time", Deaf)
    monkeypatch.setattr(Deaf, "now", 100.0)
    children = [Deaf() for _ in range(3)]
    stop_all(children)  # type: ignore[arg-type]  # what is used of them
    assert [child.told for child in children] == [["terminate", "kill"]] * 3
    assert Deaf.now == 100.0 + STOP_S
    assert STOP_S <= 1.5


def test_a_child_that_does_not_want_to_is_killed() -> None:
    children = [stubborn()]
    stop_all(children)
    assert [child.poll() for child in children] == [-9]
    for child in children:
        for pipe in (child.stdin, child.stdout):
            assert pipe is not None
            pipe.close()
