"""The store in a thread of its own, with its troubles: what cannot be opened or written is tried again, and told once.

Rule 1: SQLite never runs on the loop; one thread, one operation at a time.
Rule 2: a damaged file is set aside and replaced at once. All else (full disk, read-only or missing directory, a file
        of a later version) is tried again every `RETRY_S`, and counts as down until it works.
Rule 3: a trouble is one log line when it begins, one when its reason changes, one when it is over.
"""

from __future__ import annotations

import asyncio
import functools
import json
import logging
from collections.abc import Callable
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from pathlib import Path
from typing import Concatenate, ParamSpec, TypeVar

from gateway.clock import Clock
from gateway.core.stats import HistoryStats
from gateway.errors import HistoryError
from gateway.history.store import Store

RETRY_S = 60.0

P = ParamSpec("P")
T = TypeVar("T")

_log = logging.getLogger(__name__)


def one_thread() -> Executor:
    """Where the store runs by default."""
    return ThreadPoolExecutor(1, "history")


class AsyncStore:
    """A `Store` for coroutines. `opened` counts how often it was opened: what was known of its content may be wrong."""

    def __init__(
        self,
        directory: Path,
        clock: Clock,
        stats: HistoryStats,
        executor: Callable[[], Executor] = one_thread,
        *,
        session: int,
    ) -> None:
        """`session` as a `Store` wants it."""
        self.opened = 0
        self._directory = directory
        self._clock = clock
        self._stats = stats
        self._new_executor = executor
        self._executor: Executor | None = None
        self._store: Store | None = None
        self._busy = asyncio.Lock()
        self._retry_at = float("-inf")
        self._trouble: tuple[str, float] | None = None  # message, since
        self._session = session

    async def ready(self) -> bool:
        """Whether it can be used; opens it when it is time to try."""
        async with self._busy:
            if self._store is None and self._clock.monotonic() >= self._retry_at:
                try:
                    self._store = await self._open()
                except HistoryError as error:
                    self._down(error)
                else:
                    self._up(self._store)
            return self._store is not None

    async def _open(self) -> Store:
        """A store; one that is opened when nobody waits for it any more is closed again."""
        if self._executor is None:
            self._executor = self._new_executor()
        opening = self._executor.submit(Store, self._directory, self._session)
        try:
            return await asyncio.wrap_future(opening)
        except asyncio.CancelledError:
            opening.add_done_callback(_close_opened)
            raise

    async def call(self, method: Callable[Concatenate[Store, P], T], /, *args: P.args, **kwargs: P.kwargs) -> T:
        """What the method gives; HistoryError when it cannot, after which the store is down or a new one."""
        store, opened = self._store, self.opened
        if store is None:
            raise HistoryError("unwritable", f"{self._directory}: not open")
        try:
            return await self._in_thread(method, store, *args, **kwargs)
        except HistoryError as error:
            async with self._busy:
                if self._store is store and self.opened == opened:  # else another caller has seen to it
                    await self._replace(store, error)
            raise

    async def close(self) -> None:
        """Finish what is under way and close the file."""
        store, self._store = self._store, None
        executor, self._executor = self._executor, None
        if executor is None:
            return
        if store is not None:
            executor.submit(store.close)
        await asyncio.to_thread(executor.shutdown)

    async def _replace(self, store: Store, error: HistoryError) -> None:
        self._store = None
        if error.kind != "corrupt":
            await self._in_thread(store.close)
            self._down(error)
            return
        self._stats.store_errors[error.kind] += 1
        try:
            await self._in_thread(store.rescue, error)
        except HistoryError as worse:
            self._down(worse)
        else:
            self._store = store
            self._up(store)

    def _up(self, store: Store) -> None:
        self.opened += 1
        self._stats.store_up = True
        if self._trouble is not None:
            after_s = self._clock.monotonic() - self._trouble[1]
            _log.warning('event=history_store_restored file="%s" after_s=%.0f', store.path, after_s)
            self._trouble = None

    def _down(self, error: HistoryError) -> None:
        now = self._clock.monotonic()
        self._retry_at = now + RETRY_S
        self._stats.store_up = False
        self._stats.store_errors[error.kind] += 1
        if self._trouble is None or self._trouble[0] != str(error):
            _log.error(
                "event=history_store_failed kind=%s error=%s next=retry every_s=%.0f",
                error.kind,
                json.dumps(str(error)),
                RETRY_S,
            )
        self._trouble = (str(error), now if self._trouble is None else self._trouble[1])

    async def _in_thread(self, function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        if self._executor is None:
            self._executor = self._new_executor()
        call = functools.partial(function, *args, **kwargs)
        return await asyncio.get_running_loop().run_in_executor(self._executor, call)


def _close_opened(opening: Future[Store]) -> None:
    if not opening.cancelled() and opening.exception() is None:
        opening.result().close()
