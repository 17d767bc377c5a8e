"""Where the log goes: a thread of its own writes it, so that nobody ever waits for who reads it.

Rule 1: what is to be logged is put into a queue of `LINES`. When that is full, because the journal is slow or the pipe
        has no reader, the newest is dropped and counted; the first line that gets out again says how many were.
Rule 2: a log that cannot be written never disturbs the gateway, also not while it stops: after `FLUSH_S` it is left.
Rule 3: under systemd each line begins with its priority (sd-daemon(3)), which the journal takes away and shows.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from collections import deque
from collections.abc import Mapping

from gateway.core.stats import LogStats

LINES = 4096
FLUSH_S = 1.0

_PRIORITIES = ((logging.CRITICAL, 2), (logging.ERROR, 3), (logging.WARNING, 4), (logging.INFO, 6))
_DEBUG = 7


class LogWriter(logging.Handler):
    """The handler of all loggers: formats in the caller's thread, writes to `fd` in its own."""

    def __init__(self, fd: int, *, journal: bool, stats: LogStats | None = None) -> None:
        super().__init__()
        self.stats = stats if stats is not None else LogStats()
        self._fd = fd
        self._journal = journal
        self._queue: deque[bytes] = deque()
        self._news = threading.Condition()
        self._dropped = 0  # and not yet told
        self._writing = False
        self._ended = False
        threading.Thread(target=self._write, name="log", daemon=True).start()

    def emit(self, record: logging.LogRecord) -> None:
        """Queue a record (rule 1)."""
        with self._news:
            if len(self._queue) >= LINES:
                self._dropped += 1
                self.stats.dropped += 1
                return
        try:
            line = self._line(record)
        except Exception:  # noqa: BLE001 - a record that cannot be formatted is a mistake elsewhere, and no reason to fall
            self.handleError(record)
            return
        with self._news:
            self._queue.append(line)
            self._news.notify()

    def flush(self) -> None:
        """Wait until everything is written, but not for ever (rule 2)."""
        until = time.monotonic() + FLUSH_S
        with self._news:
            while (self._queue or self._writing) and not self._ended:
                left_s = until - time.monotonic()
                if left_s <= 0 or not self._news.wait(left_s):
                    return

    def close(self) -> None:
        """Write what is there, and nothing after it."""
        self.flush()
        with self._news:
            self._ended = True
            self._news.notify_all()
        super().close()

    def _line(self, record: logging.LogRecord) -> bytes:
        text = self.format(record)
        if self._journal:
            priority = next((number for level, number in _PRIORITIES if record.levelno >= level), _DEBUG)
            text = "\n".join(f"<{priority}>{line}" for line in text.splitlines())
        return (text + "\n").encode(errors="backslashreplace")

    def _write(self) -> None:
        while True:
            with self._news:
                self._writing = False
                self._news.notify_all()
                while not self._queue:
                    if self._ended:
                        return
                    self._news.wait()
                if self._dropped:
                    dropped, self._dropped = self._dropped, 0
                    told = logging.LogRecord(
                        __name__, logging.WARNING, __file__, 0, "event=log_dropped count=%d", (dropped,), None
                    )
                    self._queue.appendleft(self._line(told))
                data = self._queue.popleft()
                self._writing = True
            self._put(data)

    def _put(self, data: bytes) -> None:
        """Write it all, however long that takes; what nobody can read any more is lost."""
        rest = memoryview(data)
        while rest:
            try:
                rest = rest[os.write(self._fd, rest) :]
            except BlockingIOError:
                time.sleep(0.05)  # the descriptor is somebody's who made it non-blocking
            except OSError:
                self.stats.dropped += 1
                return


def journal_reads(fd: int, environment: Mapping[str, str]) -> bool:
    """Whether a descriptor leads to systemd's journal (JOURNAL_STREAM, systemd.exec(5))."""
    try:
        found = os.fstat(fd)
    except OSError:
        return False
    return environment.get("JOURNAL_STREAM") == f"{found.st_dev}:{found.st_ino}"
