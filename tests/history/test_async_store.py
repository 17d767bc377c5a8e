from __future__ import annotations

import asyncio
import threading
from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from gateway.core.stats import HistoryStats
from gateway.errors import HistoryError
from gateway.history.async_store import RETRY_S, AsyncStore
from gateway.history.store import Store
from tests.history.blocks import PLACE
from tests.history.virtual_site import VirtualClock


def fails(kind: str, text: str = "as the test wants it") -> None:
    raise HistoryError(kind, text)


@pytest.fixture
def clock() -> VirtualClock:
    return VirtualClock()


@pytest.fixture
def stats() -> HistoryStats:
    return HistoryStats()


@pytest.fixture
async def store(tmp_path: Path, clock: VirtualClock, stats: HistoryStats) -> AsyncIterator[AsyncStore]:
    opened = AsyncStore(tmp_path, clock, stats)
    yield opened
    await opened.close()


def counts(store: Store) -> tuple[int, int, float | None]:
    return store.counts(PLACE.line, PLACE.device)


async def test_it_works_in_a_thread_of_its_own(store: AsyncStore) -> None:
    assert await store.ready()
    assert await store.call(counts) == (0, 0, None)
    names = {await store.call(lambda _store: threading.current_thread().name) for _ in range(3)}
    assert names == {"history_0"}
    assert store.opened == 1


async def test_what_is_not_open_cannot_be_called(store: AsyncStore) -> None:
    with pytest.raises(HistoryError, match="not open"):
        await store.call(counts)


@pytest.mark.parametrize("kind", ["full", "unwritable", "locked"])
async def test_a_failure_takes_it_down_until_it_is_tried_again(
    store: AsyncStore, clock: VirtualClock, stats: HistoryStats, kind: str, caplog: pytest.LogCaptureFixture
) -> None:
    assert await store.ready()
    with pytest.raises(HistoryError):
        await store.call(lambda _store: fails(kind))
    assert not await store.ready()
    assert (stats.store_up, stats.store_errors[kind]) == (False, 1)
    clock.now += RETRY_S
    assert await store.ready()
    assert (stats.store_up, store.opened) == (True, 2)
    assert f"event=history_store_failed kind={kind}" in caplog.text
    assert "after_s=60" in caplog.text


async def test_several_callers_of_a_store_that_fails_take_it_down_once(store: AsyncStore, stats: HistoryStats) -> None:
    assert await store.ready()
    calls = [store.call(lambda _store: fails("full")) for _ in range(3)]
    assert all(isinstance(outcome, HistoryError) for outcome in await asyncio.gather(*calls, return_exceptions=True))
    assert stats.store_errors["full"] == 1


async def test_a_damaged_file_is_replaced_at_once(store: AsyncStore, stats: HistoryStats, tmp_path: Path) -> None:
    assert await store.ready()
    with pytest.raises(HistoryError):
        await store.call(lambda _store: fails("corrupt"))
    assert await store.ready()
    assert (stats.store_up, store.opened, stats.store_errors["corrupt"]) == (True, 2, 1)
    assert await store.call(counts) == (0, 0, None)


async def test_a_damaged_file_that_cannot_be_replaced_is_a_trouble_like_others(
    store: AsyncStore, stats: HistoryStats, clock: VirtualClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert await store.ready()
    with monkeypatch.context() as patch:
        patch.setattr(Store, "rescue", lambda _store, _error: fails("unwritable"))
        with pytest.raises(HistoryError):
            await store.call(lambda _store: fails("corrupt"))
    assert (stats.store_up, await store.ready()) == (False, False)
    clock.now += RETRY_S
    assert await store.ready()


async def test_what_is_under_way_is_finished_before_it_closes(store: AsyncStore) -> None:
    assert await store.ready()
    begun, finished = threading.Event(), threading.Event()

    def slow(opened: Store) -> None:
        begun.set()
        threading.Event().wait(0.02)
        counts(opened)
        finished.set()

    task = asyncio.create_task(store.call(slow))
    await asyncio.to_thread(begun.wait)
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
    await store.close()
    assert finished.is_set()
