"""The store for coroutines: what is opened is closed, whoever has left meanwhile."""

from __future__ import annotations

import asyncio
import threading
from pathlib import Path

import pytest

from gateway.clock import SystemClock
from gateway.core.stats import HistoryStats
from gateway.history import async_store as module
from gateway.history.async_store import AsyncStore


class SlowStore:
    """A store that takes until the test says so to open."""

    made: list[SlowStore]
    may_open = threading.Event()

    def __init__(self, directory: Path, session: int) -> None:
        self.closed = False
        self.made.append(self)
        assert self.may_open.wait(60)

    def close(self) -> None:
        self.closed = True


@pytest.fixture
def slow(monkeypatch: pytest.MonkeyPatch) -> type[SlowStore]:
    SlowStore.made = []
    SlowStore.may_open.clear()
    monkeypatch.setattr(module, "Store", SlowStore)
    return SlowStore


async def test_one_that_is_opened_when_nobody_waits_any_more_is_closed(slow: type[SlowStore], tmp_path: Path) -> None:
    store = AsyncStore(tmp_path, SystemClock(), HistoryStats(), session=1)
    opening = asyncio.create_task(store.ready())
    async with asyncio.timeout(30):
        while not slow.made:  # noqa: ASYNC110 - it is another thread that opens it
            await asyncio.sleep(0.001)
    opening.cancel()
    with pytest.raises(asyncio.CancelledError):
        await opening
    slow.may_open.set()
    await store.close()
    assert [one.closed for one in slow.made] == [True]


async def test_one_that_is_in_use_is_closed_with_it(slow: type[SlowStore], tmp_path: Path) -> None:
    store = AsyncStore(tmp_path, SystemClock(), HistoryStats(), session=1)
    slow.may_open.set()
    assert await store.ready()
    await store.close()
    assert [one.closed for one in slow.made] == [True]
