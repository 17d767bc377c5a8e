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
    """The ledger in `folder`; every method may raise OSError."""

    def __init__(self, folder: Path, *, max_bytes: int = MAX_BYTES, keep: int = KEEP) -> None:
        self._folder = folder
        self._path = folder / NAME
        self._max_bytes = max_bytes
        self._keep = keep
        self._fd: int | None = None
        self._size = 0
        self.book = Book()

    def open(self) -> Book:
        """Open it, making it where it is not there, and give what its records amount to."""
        if self._fd is not None:
            return self.book
        self._folder.mkdir(parents=True, exist_ok=True)
        self._fresh.unlink(missing_ok=True)
        book = Book()
        known = self._path if self._path.exists() else self._old(1)  # a kill between the two renames of `_begin_anew`
        if known.exists():
            book.read(known.read_bytes().splitlines(keepends=True))
        fd = self._create(self._path)
        try:
            self._size = os.fstat(fd).st_size
            if self._size and not _ends_a_line(self._path):
                self._size += os.write(fd, b"\n")
            if not self._size and (carried := _lines(book.carried(_latest(book)))):
                _write_all(fd, carried)
                self._size = len(carried)
            os.fsync(fd)
        except OSError:
            os.close(fd)
            raise
        self._fd, self.book = fd, book
        self._sync_folder()
        return book

    def append(self, records: Iterable[Record]) -> None:
        """Add records; on the disk when it returns, not there at all when it raises."""
        assert self._fd is not None, "opened first"
        records = tuple(records)
        data = _lines(records)
        if self._size and self._size + len(data) > self._max_bytes:
            self._begin_anew()
        try:
            _write_all(self._fd, data)
            os.fsync(self._fd)
        except OSError:
            os.ftruncate(self._fd, self._size)
            raise
        self._size += len(data)
        for record in records:
            self.book.apply(record)

    def close(self) -> None:
        """Close the file; `open` opens it again."""
        if self._fd is not None:
            os.close(self._fd)
            self._fd = None

    @property
    def _fresh(self) -> Path:
        return self._path.with_name(f".{NAME}.new")

    def _old(self, number: int) -> Path:
        return self._path.with_name(f"{NAME}.{number}")

    def _begin_anew(self) -> None:
        """Rule 3."""
        self._fresh.unlink(missing_ok=True)
        fd = self._create(self._fresh)
        try:
            data = _lines(self.book.carried(_latest(self.book)))
            _write_all(fd, data)
            os.fsync(fd)
            if self._path.exists():  # it is not when this broke off between the last two renames
                for number in range(self._keep, 1, -1):
                    if self._old(number - 1).exists():
                        self._old(number - 1).replace(self._old(number))
                self._path.replace(self._old(1))
            self._fresh.replace(self._path)
            self._sync_folder()
        except OSError:
            os.close(fd)
            raise
        assert self._fd is not None
        os.close(self._fd)
        self._fd, self._size = fd, len(data)

    def _create(self, path: Path) -> int:
        return os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, 0o640)

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


def _latest(book: Book) -> float:
    """The time of the latest thing that the book knows: by it, a day is counted."""
    return max((at for times in book.worn.values() for at in times), default=0.0)


def _lines(records: Iterable[Record]) -> bytes:
    return b"".join(map(encode, records))


def _write_all(fd: int, data: bytes) -> None:
    while data:
        data = data[os.write(fd, data) :]


def _ends_a_line(path: Path) -> bool:
    with path.open("rb") as file:
        file.seek(-1, os.SEEK_END)
        return file.read(1) == b"\n"
