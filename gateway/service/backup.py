"""Backup and restore of `state_dir`: history, write ledger, SNMP engine, whatever else a face keeps there.

Rule 1: a backup disturbs nobody and may be made while the gateway writes. Each file is in it as it was at one moment:
        databases by SQLite's own backup, ledgers up to their last whole line, the rest by one read, since those files
        are only ever replaced whole. What was set aside as damaged is never written again: it is copied as it is.
        Archives that somebody keeps there are left out: the next would have all of them in it, and twice the size.
Rule 2: nothing is restored below a gateway that runs (service/state_dir.py knows), and nothing of what was there is
        lost: it moves into a folder beside. An archive is checked whole before anything is moved.
Rule 3: an SNMP engine never has a number of boots twice (RFC 3414 §2.2). A restored one goes on above every number
        that may have been used since the backup, which a start a second at most could not have reached. With a clock
        that stands before the backup that cannot be told: the engine is left out, and the gateway makes a new one.
Rule 4: restored files belong to whom the folder belongs to, for the gateway is seldom root.
Rule 5: until it is whole everything is in a folder beside, which goes away with the work, also upon a signal. Of a
        backup or restore that was killed that folder stays; the next one there removes it.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import sqlite3
import tarfile
import tempfile
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import BinaryIO

from gateway import __version__
from gateway.errors import BackupError
from gateway.faces.snmp import engine
from gateway.history.database import ASIDE
from gateway.service.state_dir import held

FORMAT = 1
MANIFEST = "prostar-gateway-backup.json"
MOST_BYTES = 16 << 30  # of one file; an archive is input like any other
TRIES = 20
LAST_MOMENT = datetime(9999, 1, 1, tzinfo=UTC).timestamp()

_WORK = ".prostar-gateway-unfinished-"
_ARCHIVE = ".tar"  # in a folder of copies, none of which begins so
_DATABASE = b"SQLite format 3\0"
_BESIDE = ("-wal", "-shm", "-journal")


@dataclass(frozen=True, slots=True)
class Manifest:
    """What an archive says of itself."""

    format: int
    version: str
    site: str
    made_at: float  # Unix time


def back_up(state_dir: Path, site: str, target: Path, now: float) -> tuple[str, ...]:
    """Write what is in `state_dir` to a tar archive; gives the names in it. BackupError leaves no archive."""
    if not target.name or target.is_dir():
        raise BackupError(f"{target}: is a folder; an archive is a file")
    try:
        with _work(target.parent) as folder:
            names = _collect(state_dir, folder)
            text = json.dumps(asdict(Manifest(FORMAT, __version__, site, now)), ensure_ascii=False)
            (folder / MANIFEST).write_text(text + "\n", encoding="utf-8")
            with _create(folder / _ARCHIVE) as file:
                with tarfile.open(fileobj=file, mode="w", format=tarfile.PAX_FORMAT) as archive:
                    for name in (MANIFEST, *names):
                        archive.add(folder / name, arcname=name, recursive=False)
                file.flush()
                os.fsync(file.fileno())
            (folder / _ARCHIVE).replace(target)
    except (OSError, sqlite3.Error) as error:
        raise BackupError(f"{target}: {error}") from error
    return names


def restore(archive: Path, state_dir: Path, now: float) -> tuple[Manifest, Path | None]:
    """Put an archive's files into `state_dir`; gives what it was and where the files that were there are now."""
    try:
        state_dir.mkdir(mode=0o700, parents=True, exist_ok=True)
        with held(state_dir) as mine:
            if not mine:
                raise BackupError(f"{state_dir}: a gateway uses it; stop that first")
            with _work(state_dir) as folder:
                manifest = _unpack(archive, folder)
                _go_on_above(folder / engine.FILE_NAME, state_dir / engine.FILE_NAME, manifest.made_at, now)
                return manifest, _exchange(folder, state_dir, now)
    except tarfile.TarError as error:
        raise BackupError(f"{archive}: is no whole backup of a gateway: {error}") from error
    except (OSError, sqlite3.Error) as error:
        raise BackupError(f"{archive}: {error}") from error


@contextlib.contextmanager
def _work(parent: Path) -> Iterator[Path]:
    """A folder in `parent` for the length of the block (rule 5); who works in one holds it."""
    for left in parent.glob(f"{_WORK}*/"):
        with contextlib.suppress(OSError), held(left) as mine:
            if mine:
                shutil.rmtree(left)
    with tempfile.TemporaryDirectory(prefix=_WORK, dir=parent) as name, contextlib.ExitStack() as stack:
        with contextlib.suppress(OSError):  # a file system without locks: there nothing is removed either
            stack.enter_context(held(Path(name)))
        yield Path(name)


def _create(path: Path) -> BinaryIO:
    """A new file that nobody else can read."""
    return os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600), "wb")


def _files(state_dir: Path) -> list[Path]:
    """What is kept: plain files that are no one's working copy, and damaged ones with what belongs to them."""
    found = (path for path in state_dir.iterdir() if path.is_file() and not path.is_symlink())
    return sorted(path for path in found if not path.name.startswith(".") and not _is_working_copy(path.name))


def _is_working_copy(name: str) -> bool:
    return name.endswith(".new") or (name.endswith(_BESIDE) and ASIDE not in name)


def _collect(state_dir: Path, folder: Path) -> tuple[str, ...]:
    """Copy every file; a ledger may move on meanwhile, so that what was opened is compared with what is there then."""
    for _ in range(TRIES):
        with contextlib.ExitStack() as stack:
            try:
                opened = [(path, stack.enter_context(path.open("rb"))) for path in _files(state_dir)]
                as_opened = [(path.name, os.fstat(file.fileno()).st_ino) for path, file in opened]
                as_it_is = [(path.name, path.stat().st_ino) for path in _files(state_dir)]
            except FileNotFoundError:
                if not state_dir.exists():
                    raise
                continue
            if as_opened != as_it_is:
                continue
            kept = [(path, file) for path, file in opened if not _is_archive(file)]
            for path, file in kept:
                head = file.read(len(_DATABASE))
                file.seek(0)
                if head == _DATABASE and ASIDE not in path.name:
                    _copy_database(path, folder / path.name)
                else:
                    data = file.read()
                    if ".jsonl" in path.name:
                        data = data[: data.rfind(b"\n") + 1]
                    (folder / path.name).write_bytes(data)
            return tuple(path.name for path, _ in kept)
    raise BackupError(f"{state_dir}: files come and go too fast")


def _is_archive(file: BinaryIO) -> bool:
    """Whether a backup is in it, and then nothing else."""
    try:
        with tarfile.open(fileobj=file, mode="r:") as archive:
            first = archive.next()
            return first is not None and first.name == MANIFEST
    except tarfile.TarError:
        return False
    finally:
        file.seek(0)


def _copy_database(path: Path, copy: Path) -> None:
    with (
        closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True, timeout=10.0)) as source,
        closing(sqlite3.connect(copy)) as target,
    ):
        try:
            source.backup(target)
            target.execute("PRAGMA journal_mode = DELETE")  # one file, nothing beside it
            damage = _damage(target)  # pages are copied as they are, and nothing damaged would be restored
        except sqlite3.DatabaseError as error:
            if error.sqlite_errorcode & 0xFF not in {sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB}:
                raise
            damage = str(error)
    if damage:
        raise BackupError(f"{path}: {damage}; restart the gateway, which sets it aside, and try again")
    copy.chmod(0o600)


def _damage(connection: sqlite3.Connection) -> str:
    """What is wrong with a database, in one line; "" when it is whole."""
    (found,) = connection.execute("PRAGMA quick_check(1)").fetchone()
    return "" if found == "ok" else " ".join(str(found).split())


def _unpack(archive: Path, folder: Path) -> Manifest:
    """Every file of an archive, checked; BackupError when anything about it is not as `back_up` makes it."""
    with tarfile.open(archive, "r:") as tar:
        for member in tar:
            odd = "/" in member.name or member.name.startswith(".") or _is_working_copy(member.name)
            if odd or not member.isreg() or member.size > MOST_BYTES:
                raise BackupError(f"{archive}: {member.name!r} does not belong into a backup")
            source = tar.extractfile(member)
            assert source is not None, "a regular file"
            with source, _create(folder / member.name) as file:
                shutil.copyfileobj(source, file)
                file.flush()
                os.fsync(file.fileno())
    try:
        manifest = Manifest(**json.loads((folder / MANIFEST).read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError) as error:
        raise BackupError(f"{archive}: is no backup of a gateway") from error
    if manifest.format != FORMAT:
        raise BackupError(f"{archive}: has format {manifest.format!r}, which this version does not know")
    at: object = manifest.made_at  # what is in an archive is anything
    if not isinstance(at, int | float) or not 0 <= at < LAST_MOMENT or not str(manifest.site).isprintable():
        raise BackupError(f"{archive}: is no backup of a gateway")
    (folder / MANIFEST).unlink()
    for path in _files(folder):
        _check_database(path, archive)
    return manifest


def _check_database(path: Path, archive: Path) -> None:
    with path.open("rb") as file:
        if ASIDE in path.name or file.read(len(_DATABASE)) != _DATABASE:
            return
    with closing(sqlite3.connect(path)) as connection:
        damage = _damage(connection)
    if damage:
        raise BackupError(f"{archive}: {path.name} is damaged: {damage}")


def _go_on_above(restored: Path, present: Path, made_at: float, now: float) -> None:
    """Rule 3."""
    if not restored.exists():
        return
    state = engine.parse_state(restored.read_bytes())
    if state is None or now < made_at:
        restored.unlink()
        return
    engine_id, boots = state
    boots += int(now - made_at) + 1
    with contextlib.suppress(OSError):
        there = engine.parse_state(present.read_bytes())
        if there is not None and there[0] == engine_id:
            boots = max(boots, there[1])
    if boots >= engine.MAX_BOOTS:
        restored.unlink()
        return
    restored.write_bytes(engine.state_text(engine_id, boots))


def _exchange(folder: Path, state_dir: Path, now: float) -> Path | None:
    """Move what is there aside and the new files in."""
    owner = state_dir.stat()
    moved = None
    there = [path for path in state_dir.iterdir() if path.is_file()]
    if there:
        moved = _new_folder(state_dir, time.strftime("replaced-%Y%m%dT%H%M%SZ", time.gmtime(now)))
        _give(moved, owner)
        for path in there:
            path.rename(moved / path.name)
    for path in sorted(folder.iterdir()):
        _give(path, owner)
        path.rename(state_dir / path.name)
    fd = os.open(state_dir, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)
    return moved


def _give(path: Path, owner: os.stat_result) -> None:
    if os.geteuid() == 0:
        os.chown(path, owner.st_uid, owner.st_gid)


def _new_folder(parent: Path, name: str) -> Path:
    def names() -> Iterator[str]:
        yield name
        for number in range(2, 1000):
            yield f"{name}-{number}"

    for each in names():
        with contextlib.suppress(FileExistsError):
            (parent / each).mkdir(mode=0o700)
            return parent / each
    raise BackupError(f"{parent / name}: is there already")
