"""F86: 100,000 connections come and go; descriptors, tasks, threads and memory are what they were before."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import pytest

from gateway.clock import SystemClock
from gateway.faces.modbus.connection import Connection
from gateway.faces.modbus.sockets import SocketTransport
from gateway.service.config import load_config
from gateway.service.gateway import Gateway
from tests.e2e.programs import write_config
from tests.soak.process import Held

CONNECTOR = Path(__file__).with_name("connector.py")
PART = 4800  # each process goes through all the ways equally often
WARM_UP = 4800
MOST_GROWTH_KIB = 1024


async def connect(port: int, count: int) -> int:
    """So many connections by two processes; gives how many replies they had."""
    processes = [
        await asyncio.create_subprocess_exec(
            sys.executable, str(CONNECTOR), str(port), str(count // 2), stdout=subprocess.PIPE
        )
        for _ in range(2)
    ]
    return sum([int((await process.communicate())[0]) for process in processes])


def descriptors() -> Counter[str]:
    """What the descriptors of this process lead to."""
    found = []
    for each in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(OSError):  # closed meanwhile
            found.append(re.sub(r":\[\d+\]", "", str(each.readlink())))
    return Counter(found)


async def settled() -> tuple[Held, int]:
    """What is held, and how many tasks, when nothing changes any more."""
    held, tasks = Held.of("self"), len(asyncio.all_tasks())
    for _ in range(100):
        gc.collect()
        await asyncio.sleep(0.1)
        before, held = held, Held.of("self")
        tasks_before, tasks = tasks, len(asyncio.all_tasks())
        if before.handles == held.handles and tasks == tasks_before:
            break
    return held, tasks


@pytest.mark.parametrize("count", [4800, pytest.param(100_800, marks=[pytest.mark.long, pytest.mark.timeout(1200)])])
async def test_connections_leave_nothing(
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    free_tcp_port: Callable[[], int],
    free_udp_port: Callable[[], int],
    count: int,
) -> None:
    caplog.set_level("CRITICAL")  # what pytest keeps of the log would be what grows
    port = free_tcp_port()
    write_config(tmp_path / "site.toml", (port, free_udp_port(), free_tcp_port()))
    gateway = Gateway(load_config(tmp_path / "site.toml"), SystemClock())
    stop = asyncio.Event()
    running = asyncio.create_task(gateway.run(stop))
    try:
        while gateway.not_ready():  # noqa: ASYNC110  # there is no event for it
            await asyncio.sleep(0.01)
        await connect(port, min(WARM_UP, count))
        before, tasks_before = await settled()
        was = descriptors()
        samples = []
        replies = 0
        for _ in range(count // PART):
            replies += await connect(port, PART)
            samples.append(Held.of("self"))
        after, tasks_after = await settled()
        now = descriptors()
    finally:
        stop.set()
        await running
    assert replies == count * 6 // 8
    history = str(tmp_path / "state" / "history.sqlite3")
    assert now.pop(history, 0) <= 2  # SQLite keeps a reader's for the next: closing it would drop the writer's lock
    assert now - was == Counter()
    assert (after.threads, tasks_after) == (before.threads, tasks_before)
    assert after.rss_kib - before.rss_kib < MOST_GROWTH_KIB, [each.rss_kib for each in samples]


async def test_a_connection_that_ended_is_freed_without_the_collector(
    tmp_path: Path, free_tcp_port: Callable[[], int], free_udp_port: Callable[[], int]
) -> None:
    """Circles would be freed only when a hundred thousand have come together: megabytes, and a long pause."""
    port = free_tcp_port()
    write_config(tmp_path / "site.toml", (port, free_udp_port(), free_tcp_port()))
    gateway = Gateway(load_config(tmp_path / "site.toml"), SystemClock())
    stop = asyncio.Event()
    running = asyncio.create_task(gateway.run(stop))
    try:
        while gateway.not_ready():  # noqa: ASYNC110  # there is no event for it
            await asyncio.sleep(0.01)
        gc.collect()
        gc.disable()
        await connect(port, 160)
        left = [each for each in gc.get_objects() if isinstance(each, (Connection, SocketTransport))]
        assert left == []
    finally:
        gc.enable()
        stop.set()
        await running
