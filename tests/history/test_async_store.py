"""The store for coroutines: what is opened is closed, whoever has left meanwhile."""

from __future__ import annotations

import asyncio
import threading
from pathlib import Path

import pytest

from gateway.clock import SystemClock
from gateway.core.stats import HistoryStats
from gateway.errors import HistoryError
from gateway.history import async_store as module
from gateway.history.async_store import AsyncStore
from gateway.history.store import Store


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


def set_aside(directory: Path) -> list[Path]:
    return list(directory.glob("*.corrupt-*"))


async def test_a_damaged_file_that_several_meet_at_once_is_set_aside_once(tmp_path: Path) -> None:
    def damaged(_store: Store) -> None:
        raise HistoryError("corrupt", "database disk image is malformed")

    store = AsyncStore(tmp_path, SystemClock(), HistoryStats(), session=1)
    assert await store.ready()
    met = await asyncio.gather(*(store.call(damaged) for _ in range(3)), return_exceptions=True)
    assert [type(error) for error in met] == [HistoryError] * 3
    assert store.opened == 2
    await store.close()
    assert len(set_aside(tmp_path)) == 1
