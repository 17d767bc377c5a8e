"""F51: boots grow strictly, and a kill at any step leaves the old state or the new, never garbage (RFC 3414 §2.2)."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from gateway.errors import ListenError
from gateway.faces.snmp.agent import SnmpAgent
from gateway.faces.snmp.engine import FILE_NAME, parse_state, start_engine
from tests.faces.snmp.poller import a_user

STEPS = ("open", "write", "fsync", "close", "rename", "open", "fsync", "close")
"""What saving does, in order; the child below ends itself before or after one of them."""

CHILD = """
import os, signal, sys
from pathlib import Path
from gateway.faces.snmp.engine import start_engine
wanted, when, done = int(sys.argv[2]), sys.argv[3], 0
def watched(name):
    real = getattr(os, name)
    def call(*arguments, **named):
        global done
        if when == "before" and done == wanted:
            os.kill(os.getpid(), signal.SIGKILL)
        if when == "half" and done == wanted and name == "write":
            real(arguments[0], arguments[1][:20])
            os.kill(os.getpid(), signal.SIGKILL)
        result = real(*arguments, **named)
        done += 1
        if when == "after" and done == wanted + 1:
            os.kill(os.getpid(), signal.SIGKILL)
        return result
    setattr(os, name, call)
for name in ("open", "write", "fsync", "close", "rename"):
    watched(name)
start_engine(Path(sys.argv[1]), 32473, 0.0)
os._exit(0)
"""


def kept(folder: Path) -> tuple[bytes, int] | None:
    return parse_state((folder / FILE_NAME).read_bytes())


def names(folder: Path) -> list[str]:
    return [path.name for path in folder.iterdir()]


def test_every_start_counts_one(tmp_path: Path) -> None:
    made = [start_engine(tmp_path, 32473, 0.0) for _ in range(4)]
    assert [engine.boots for engine in made] == [1, 2, 3, 4]
    assert len({engine.engine_id for engine in made}) == 1
    assert kept(tmp_path) == (made[0].engine_id, 4)
    assert names(tmp_path) == [FILE_NAME]
    assert (tmp_path / FILE_NAME).stat().st_mode & 0o777 == 0o600


@pytest.mark.parametrize(
    ("step", "when"),
    [(step, when) for step in range(len(STEPS)) for when in ("before", "after")] + [(1, "half")],
)
def test_kill_9_at_every_step_leaves_old_or_new(tmp_path: Path, step: int, when: str) -> None:
    engine = start_engine(tmp_path, 32473, 0.0)
    child = subprocess.run([sys.executable, "-c", CHILD, str(tmp_path), str(step), when], check=False, timeout=60)
    assert child.returncode == -signal.SIGKILL
    left = kept(tmp_path)
    assert left is not None
    assert left in {(engine.engine_id, 1), (engine.engine_id, 2)}
    # What the child may have used is on disk, so the next start is above it.
    assert start_engine(tmp_path, 32473, 0.0).boots == left[1] + 1


def test_the_steps_are_those_that_the_kills_go_through(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[str] = []

    def watched(name: str, real: Callable[..., object]) -> Callable[..., object]:
        def call(*arguments: object, **named: object) -> object:
            seen.append(name)
            return real(*arguments, **named)

        return call

    start_engine(tmp_path, 32473, 0.0)
    for name in set(STEPS):
        monkeypatch.setattr(os, name, watched(name, getattr(os, name)))
    start_engine(tmp_path, 32473, 0.0)
    assert tuple(seen) == STEPS


async def test_boots_are_on_disk_before_the_socket_is_bound(
    make_agent: Callable[..., SnmpAgent], tmp_path: Path
) -> None:
    agent = make_agent(users=(a_user(),), state_dir=tmp_path, listen=(("192.0.2.1", 0),))
    assert names(tmp_path) == []  # building opens nothing
    with pytest.raises(ListenError):
        await agent.listeners[0].start()
    first = kept(tmp_path)
    with pytest.raises(ListenError):
        await agent.listeners[0].start()
    assert first is not None
    assert kept(tmp_path) == first  # one start of the program is one boot, however often a listener tries
    assert agent.engine().boots == first[1] == 1


async def test_without_users_nothing_is_written(make_agent: Callable[..., SnmpAgent], tmp_path: Path) -> None:
    listener = make_agent(state_dir=tmp_path).listeners[0]
    await listener.start()
    await listener.stop()
    assert names(tmp_path) == []
