"""The write ledger as the event loop sees it: one thread that touches its files, in order.

Rule 1: what must be on the disk before something happens (`note_first`) is said to be there, or not to be.
Rule 2: what only has to be noted (`note`) is noted as soon as that is possible: what the disk did not take follows with
        the next thing that it takes. At most `MAX_UNSAVED` records wait so; the oldest go first.
Rule 3: the log hears once that the ledger fails, and once that it works again.
"""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

from gateway.core.write_ledger import Book, Record
from gateway.faces.modbus.ledger import LedgerFile

logger = logging.getLogger(__name__)

MAX_UNSAVED = 1024

Then = Callable[[bool], None]


class Journal:
    """The ledger in `folder`; `open` comes first, on the running loop. What it calls back, it calls on that loop."""

    def __init__(self, folder: Path) -> None:
        self._file = LedgerFile(folder)
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="write-ledger")
        self._loop: asyncio.AbstractEventLoop | None = None
        self._unsaved: deque[Record] = deque(maxlen=MAX_UNSAVED)
        self._failing = False

    def open(self, then: Callable[[Book | None], None]) -> None:
        """Read what is there; `then` gets what it amounts to, None when it cannot be opened."""
        self._loop = asyncio.get_running_loop()

        def opened(*, works: bool) -> None:
            then(self._file.book if works else None)

        self._do(self._file.open, opened)

    def note(self, *records: Record) -> None:
        """Rule 2."""
        self._unsaved.extend(records)
        self._append((), None)

    def note_first(self, records: tuple[Record, ...], then: Then) -> None:
        """Rule 1; `then` gets whether they are on the disk. When not, they are not there at all."""
        self._append(records, then)

    def _append(self, records: tuple[Record, ...], then: Then | None) -> None:
        waited = tuple(self._unsaved)
        self._unsaved.clear()

        def append() -> None:
            self._file.open()
            self._file.append((*waited, *records))

        def appended(*, works: bool) -> None:
            if not works:
                self._unsaved.extendleft(reversed(waited))
            if then is not None:
                then(works)

        self._do(append, appended)

    def _do(self, work: Callable[[], object], then: Callable[..., None]) -> None:
        """Have the thread do something, and tell on the loop whether it could."""
        loop = self._loop
        assert loop is not None, "opened first"

        def done(future: Future[object]) -> None:
            with suppress(RuntimeError):  # the loop has ended: nobody waits any more
                loop.call_soon_threadsafe(self._done, future.exception(), then)

        self._thread.submit(work).add_done_callback(done)

    def _done(self, error: BaseException | None, then: Callable[..., None]) -> None:
        if error is not None and not self._failing:
            unforeseen = None if isinstance(error, OSError) else error
            text = str(error).replace('"', "'")
            logger.error('event=write_ledger_failed error="%s" writes=refused', text, exc_info=unforeseen)
        elif error is None and self._failing:
            logger.warning("event=write_ledger_works_again")
        self._failing = error is not None
        then(works=error is None)
