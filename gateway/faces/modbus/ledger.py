"""The write ledger's files.

Rule 1: lines are only ever added. What `append` took is on the disk when it returns; what it could not take leaves no
        trace, so that a full disk refuses writes and breaks nothing.
Rule 2: a line that a power failure cut off is left as it is; the next one begins on a line of its own.
Rule 3: the size is bounded: at `max_bytes` a new file is begun with what is still needed (write_ledger.py), and the
        old ones move on; `keep` of them stay. The new file is whole before it takes its place, so that a kill at any
        moment leaves the old one or the new one.

Everything here blocks; faces/modbus/journal.py calls it in a thread of its own.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from pathlib import Path

from gateway.core.write_ledger import Book, Record, decode, encode

NAME = "writes.jsonl"
MAX_BYTES = 1 << 20
KEEP = 4


class LedgerFile:
    """The ledger in `folder`; every method may raise OSError. Nothing is kept open between two calls."""

    def __init__(self, folder: Path, *, max_bytes: int = MAX_BYTES, keep: int = KEEP) -> None:
        self._folder = folder
        self._path = folder / NAME
        self._max_bytes = max_bytes
        self._keep = keep
        self._book: Book | None = None

    @property
    def book(self) -> Book:
        """What its records amount to; it was opened before."""
        assert self._book is not None, "opened first"
        return self._book

    def open(self) -> None:
        """Read what is there, once, and prove that it can be added to."""
        if self._book is not None:
            return
        self._folder.mkdir(parents=True, exist_ok=True)
        self._fresh.unlink(missing_ok=True)
        book = Book()
        known = self._path if self._size() else self._old(1)  # a kill between the two renames of `_begin_anew`
        if known.exists():
            book.read(known.read_bytes().splitlines(keepends=True))
        self._book = book
        try:
            self.append(())
            self._sync_folder()
        except OSError:
            self._book = None
            raise

    def append(self, records: Iterable[Record]) -> None:
        """Add records; on the disk when it returns, not there at all when it raises."""
        records = tuple(records)
        data = b"".join(map(encode, records))
        if self._size() and self._size() + len(data) > self._max_bytes:
            self._begin_anew()
        fd = self._open_for_adding(self._path)
        try:
            size = os.fstat(fd).st_size
            if not size:
                data = self._carried() + data
            elif os.pread(fd, 1, size - 1) != b"\n":
                data = b"\n" + data
            try:
                _write_all(fd, data)
                os.fsync(fd)
            except OSError:
                os.ftruncate(fd, size)
                raise
        finally:
            os.close(fd)
        for record in records:
            self.book.apply(record)

    @property
    def _fresh(self) -> Path:
        return self._path.with_name(f".{NAME}.new")

    def _old(self, number: int) -> Path:
        return self._path.with_name(f"{NAME}.{number}")

    def _size(self) -> int:
        return self._path.stat().st_size if self._path.exists() else 0

    def _begin_anew(self) -> None:
        """Rule 3."""
        self._fresh.unlink(missing_ok=True)
        fd = self._open_for_adding(self._fresh)
        try:
            _write_all(fd, self._carried())
            os.fsync(fd)
        finally:
            os.close(fd)
        for number in range(self._keep, 1, -1):
            if self._old(number - 1).exists():
                self._old(number - 1).replace(self._old(number))
        self._path.replace(self._old(1))
        self._fresh.replace(self._path)
        self._sync_folder()

    def _carried(self) -> bytes:
        book = self.book
        latest = max((at for times in book.worn.values() for at in times), default=0.0)
        return b"".join(map(encode, book.carried(latest)))

    def _open_for_adding(self, path: Path) -> int:
        return os.open(path, os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, 0o640)

    def _sync_folder(self) -> None:
        fd = os.open(self._folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            os.fsync(fd)
        finally:
            os.close(fd)


def read_ledger(folder: Path) -> Iterator[Record]:
    """All records in the files of a ledger, oldest first; what is no record is left out; may raise OSError."""
    old = sorted(folder.glob(f"{NAME}.[0-9]*"), key=lambda path: -int(path.suffix[1:]))
    for path in (*old, folder / NAME):
        if path.exists():
            for line in path.read_bytes().splitlines():
                record = decode(line)
                if record is not None:
                    yield record


def _write_all(fd: int, data: bytes) -> None:
    while data:
        data = data[os.write(fd, data) :]
