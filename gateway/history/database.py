"""The file that the history lives in: opened, checked, set aside when it is damaged.

Rule 1: SQLite with a write-ahead log; a transaction is there whole or not at all after a kill or a power cut, and
        survives both once it is committed (synchronous=FULL). Blocks that only wait for their ring to be complete
        are committed without that (they can be read again).
Rule 2: a damaged file is renamed, never deleted and never written again; a new one takes its place and is filled from
        the controllers. Days that are older than their rings are then only in the old file.
Rule 3: a file of a later version is left alone, and so is one that is no history.
Rule 4: every failure is a HistoryError with a kind.
"""

from __future__ import annotations

import errno
import logging
import os
import sqlite3
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from gateway.errors import HistoryError

FILE_NAME = "history.sqlite3"
VERSION = 1
APPLICATION_ID = 0x50534758  # "PSGX"
BUSY_S = 5.0
ASIDE = ".corrupt-"
"""In the names of damaged files (rule 2); behind it is when that was found."""

_log = logging.getLogger(__name__)

_SCHEMA = f"""
CREATE TABLE controller (
  key INTEGER PRIMARY KEY,
  identity TEXT NOT NULL UNIQUE,      -- what exports call it; never changes
  model TEXT NOT NULL,
  product TEXT NOT NULL,
  revision TEXT NOT NULL,
  serial TEXT NOT NULL,               -- "" where it tells none
  line TEXT NOT NULL,                 -- where it was seen last
  device TEXT NOT NULL,
  unit_id INTEGER NOT NULL,
  first_wall REAL NOT NULL,           -- Unix time of the first and of the last look, by the gateway's clock
  look_wall REAL NOT NULL,
  look_hours INTEGER NOT NULL,        -- its hourmeter at the last look
  word_order TEXT NOT NULL,
  newest_slot INTEGER,                -- where the next harvest begins; NULL: the whole ring has to be read
  newest_hourmeter INTEGER
);
CREATE TABLE day (
  controller INTEGER NOT NULL REFERENCES controller (key),
  hourmeter INTEGER NOT NULL,         -- hours, when the day was written
  slot INTEGER NOT NULL,
  words BLOB NOT NULL CHECK (length(words) > 0),  -- the block, big endian
  word_order TEXT NOT NULL,           -- of its 32-bit fields: 'hi-lo' or 'lo-hi'
  fields TEXT NOT NULL,               -- decoded, JSON by field name in the units of the map
  read_wall REAL NOT NULL,            -- Unix time, when it was harvested
  session INTEGER NOT NULL,           -- which run of the gateway harvested it
  written_wall REAL,                  -- Unix time, estimated; NULL: the clock was not set
  error_s REAL,                       -- by how much the estimate may be wrong, either way
  PRIMARY KEY (controller, hourmeter)
) WITHOUT ROWID;
CREATE TABLE apart (                  -- written blocks that are no day
  controller INTEGER NOT NULL REFERENCES controller (key),
  slot INTEGER NOT NULL,
  words BLOB NOT NULL,
  hourmeter INTEGER NOT NULL,
  why TEXT NOT NULL,                  -- 'ahead', 'order' or 'tie'
  read_wall REAL NOT NULL,
  PRIMARY KEY (controller, slot, words)
) WITHOUT ROWID;
CREATE TABLE staging (                -- a ring that is being read whole
  device TEXT PRIMARY KEY,
  line TEXT NOT NULL,
  model TEXT NOT NULL,
  product TEXT NOT NULL,
  serial TEXT NOT NULL,
  look_hours INTEGER NOT NULL
) WITHOUT ROWID;
CREATE TABLE staged (
  device TEXT NOT NULL REFERENCES staging (device) ON DELETE CASCADE,
  slot INTEGER NOT NULL,
  words BLOB NOT NULL,
  PRIMARY KEY (device, slot)
) WITHOUT ROWID;
PRAGMA application_id = {APPLICATION_ID};
PRAGMA user_version = {VERSION};
"""


@contextmanager
def explained(path: Path) -> Iterator[None]:
    """Turn what SQLite and the system raise into a HistoryError (rule 4)."""
    try:
        yield
    except sqlite3.Error as error:
        raise HistoryError(_kind(error), f"{path}: {error}") from error
    except OSError as error:
        kind = "full" if error.errno in {errno.ENOSPC, errno.EDQUOT} else "unwritable"
        raise HistoryError(kind, f"{path}: {error.strerror or error}") from error


def open_database(directory: Path) -> sqlite3.Connection:
    """The history of this directory, for writing; made when it is not there. HistoryError when that cannot be."""
    path = directory / FILE_NAME
    with explained(directory):
        try:
            directory.mkdir(mode=0o750, parents=True, exist_ok=True)
        except FileExistsError:
            raise HistoryError("unwritable", f"{directory}: is no directory") from None
    try:
        return _open(path)
    except HistoryError as error:
        if error.kind != "corrupt":
            raise
        set_aside(path, str(error))
        return _open(path)


def open_for_reading(directory: Path) -> sqlite3.Connection:
    """The history of this directory, read only, beside a gateway that writes it; HistoryError when it cannot be."""
    path = directory / FILE_NAME
    with explained(path):
        if not path.is_file():
            raise HistoryError("missing", f"{path}: there is no history yet")
    try:
        return _open_for_reading(path, "mode=ro")
    except HistoryError as error:
        # A reader needs the files beside a write-ahead log, and makes them where it may. Where it may not and there
        # are none, nobody has the history open, and it can be read as it lies.
        if error.kind != "unwritable" or path.with_name(path.name + "-wal").exists():
            raise
        return _open_for_reading(path, "mode=ro&immutable=1")


def set_aside(path: Path, why: str) -> Path:
    """Rename a damaged file and what belongs to it; gives the new name."""
    stamp = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime())
    number = 0
    while True:
        aside = path.with_name(f"{path.name}{ASIDE}{stamp}" + (f"-{number}" if number else ""))
        if not aside.exists():
            break
        number += 1
    with explained(path):
        path.rename(aside)
        for ending in ("-wal", "-shm"):
            if path.with_name(path.name + ending).exists():
                path.with_name(path.name + ending).rename(aside.with_name(aside.name + ending))
    _log.error(
        'event=history_set_aside file="%s" now="%s" reason="%s" next="a new file is filled from the controllers; '
        'older days may be rescued from the old one with sqlite3 .recover"',
        path,
        aside,
        why.replace('"', "'"),
    )
    return aside


@contextmanager
def transaction(connection: sqlite3.Connection) -> Iterator[None]:
    """All of it or nothing."""
    connection.execute("BEGIN IMMEDIATE")
    try:
        yield
    except BaseException:
        if connection.in_transaction:  # a full disk may have ended it already
            connection.execute("ROLLBACK")
        raise
    connection.execute("COMMIT")


def _open_for_reading(path: Path, options: str) -> sqlite3.Connection:
    with explained(path):
        connection = sqlite3.connect(
            f"{path.absolute().as_uri()}?{options}",
            uri=True,
            timeout=BUSY_S,
            isolation_level=None,
            check_same_thread=False,  # an export goes through a pool of threads, one at a time
        )
        try:
            written = _check_kind(connection, path)
        except BaseException:
            connection.close()
            raise
    if not written:
        connection.close()
        raise HistoryError("missing", f"{path}: there is no history yet")
    return connection


def _open(path: Path) -> sqlite3.Connection:
    with explained(path):
        connection = sqlite3.connect(path, timeout=BUSY_S, isolation_level=None, check_same_thread=False)
        try:
            _prepare(connection, path)
        except BaseException:
            connection.close()
            raise
        return connection


def _prepare(connection: sqlite3.Connection, path: Path) -> None:
    if _check_kind(connection, path):
        with closing(connection.execute("PRAGMA quick_check(1)")) as cursor:
            (found,) = cursor.fetchone()
        if found != "ok":
            raise HistoryError("corrupt", f"{path}: {found}")
    connection.execute("PRAGMA journal_mode = WAL")
    connection.execute("PRAGMA synchronous = FULL")
    connection.execute("PRAGMA foreign_keys = ON")
    with transaction(connection):
        if not _check_kind(connection, path):
            for statement in _SCHEMA.split(";\n"):
                connection.execute(statement)
        connection.execute(f"PRAGMA user_version = {VERSION}")  # shows whether the file can be written at all
    if not os.access(path, os.W_OK):
        raise HistoryError("unwritable", f"{path}: is read-only")


def _check_kind(connection: sqlite3.Connection, path: Path) -> bool:
    """Whether the file is a history that this version can use, False when it is empty; HistoryError (rule 3)."""
    (application,) = connection.execute("PRAGMA application_id").fetchone()
    (version,) = connection.execute("PRAGMA user_version").fetchone()
    if application == APPLICATION_ID and version == VERSION:
        return True
    if application == APPLICATION_ID and version > VERSION:
        raise HistoryError("newer", f"{path}: was written by a later version of the gateway (format {version})")
    if connection.execute("SELECT count(*) FROM sqlite_schema").fetchone() != (0,):
        raise HistoryError("unwritable", f"{path}: is a database of something else")
    return False


def _kind(error: sqlite3.Error) -> str:
    name = getattr(error, "sqlite_errorname", "") or ""
    if name.startswith(("SQLITE_CORRUPT", "SQLITE_NOTADB")):
        return "corrupt"
    if name.startswith("SQLITE_FULL"):
        return "full"
    if name.startswith(("SQLITE_BUSY", "SQLITE_LOCKED")):
        return "locked"
    return "unwritable"
