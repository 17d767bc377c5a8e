"""Backup and restore of state_dir: whole while everything writes, and an SNMP engine that never repeats itself."""

from __future__ import annotations

import gzip
import json
import os
import signal
import sqlite3
import subprocess
import sys
import tarfile
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pytest

from gateway.core.write_ledger import Fate, Intent, Verdict
from gateway.devices.model import Space
from gateway.errors import BackupError
from gateway.faces.modbus.ledger import NAME, LedgerFile, read_ledger
from gateway.faces.snmp import engine
from gateway.history.database import FILE_NAME, open_database, open_for_reading, set_aside
from gateway.service.backup import MANIFEST, back_up, restore
from gateway.service.state_dir import claimed, held

MADE = 1_800_000_000.0
LATER = MADE + 3600.0
BESIDE = ("-wal", "-shm")  # SQLite's own, beside the history
ENGINE = bytes.fromhex("800007d905000102030405060708090a0b")


def intent(number: int) -> Intent:
    return Intent(
        f"{number:08x}",
        MADE + number,
        peer="192.0.2.7",
        role=None,
        device="array-1",
        unit_id=11,
        point="float_voltage",
        space=Space.REGISTERS,
        address=0xE001,
        old=0x4AE6,
        new=number,
        wears=True,
    )


@pytest.fixture
def state(tmp_path: Path) -> Path:
    """A state_dir with something of everything in it."""
    folder = tmp_path / "state"
    ledger = LedgerFile(folder)
    ledger.open()
    ledger.append([intent(1), Verdict("00000001", MADE, Fate.WRITTEN)])
    with closing(open_database(folder)) as connection:
        add_controller(connection, 1)
    (folder / engine.FILE_NAME).write_bytes(engine.state_text(ENGINE, 7))
    return folder


def add_controller(connection: sqlite3.Connection, number: int) -> None:
    """Two rows that belong together: one transaction."""
    connection.execute("BEGIN IMMEDIATE")
    connection.execute(
        "INSERT INTO controller VALUES (?, ?, 'm', 'p', 'r', 's', 'l', 'd', 11, 0, 0, 0, 'hi-lo', NULL, NULL)",
        (number, f"c{number}"),
    )
    connection.execute("INSERT INTO day VALUES (?, 1, 0, x'00', 'hi-lo', '{}', 0, 1, NULL, NULL)", (number,))
    connection.execute("COMMIT")


def history(folder: Path) -> tuple[int, int]:
    with closing(open_for_reading(folder)) as connection:
        controllers, days = (
            connection.execute(f"SELECT count(*) FROM {table}").fetchone()[0] for table in ("controller", "day")
        )
        return controllers, days


def boots(folder: Path) -> tuple[bytes, int] | None:
    return engine.parse_state((folder / engine.FILE_NAME).read_bytes())


def members(archive: Path) -> dict[str, bytes]:
    with tarfile.open(archive) as tar:
        return {member.name: tar.extractfile(member).read() for member in tar}  # type: ignore[union-attr]  # plain files


def pack(archive: Path, files: dict[str, bytes]) -> None:
    """An archive as somebody else would make it."""
    folder = archive.parent / "packed"
    folder.mkdir(exist_ok=True)
    with tarfile.open(archive, "w") as tar:
        for number, (name, content) in enumerate(files.items()):
            (folder / str(number)).write_bytes(content)
            tar.add(folder / str(number), arcname=name)


def test_everything_comes_back(state: Path, tmp_path: Path) -> None:
    archive = tmp_path / "backup.tar"
    names = back_up(state, "ridge-07", archive, MADE)
    assert names == (FILE_NAME, engine.FILE_NAME, NAME)
    assert archive.stat().st_mode & 0o777 == 0o600
    manifest, moved = restore(archive, tmp_path / "elsewhere" / "new", LATER)
    assert (manifest.site, manifest.made_at, moved) == ("ridge-07", MADE, None)
    new = tmp_path / "elsewhere" / "new"
    assert history(new) == (1, 1)
    assert list(read_ledger(new)) == [intent(1), Verdict("00000001", MADE, Fate.WRITTEN)]
    assert sorted(path.name for path in new.iterdir() if not path.name.endswith(BESIDE)) == sorted(names)


@contextmanager
def busy(work: Callable[[int], None]) -> Iterator[list[int]]:
    """Work in a thread of its own, again and again; gives how often until now."""
    stop, done = threading.Event(), [0]

    def run() -> None:
        while not stop.is_set():
            done[0] += 1
            work(done[0])

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield done
    finally:
        stop.set()
        thread.join()


def test_what_was_backed_up_while_it_was_written_is_whole(state: Path, tmp_path: Path) -> None:
    """Days are added, the ledger turns over its files, and the engine starts anew all the time."""
    ledger = LedgerFile(state, max_bytes=3000)
    ledger.open()

    def write(number: int) -> None:
        with closing(open_database(state)) as connection:
            add_controller(connection, 1 + number)
        ledger.append([intent(1 + number), Verdict(f"{1 + number:08x}", MADE, Fate.WRITTEN)])
        engine.start_engine(state, 32473, 0.0)

    seen: list[tuple[int, int]] = []
    with busy(write) as done:
        for number in range(12):
            before = done[0]
            archive = tmp_path / f"{number}.tar"
            back_up(state, "ridge-07", archive, MADE)
            new = tmp_path / f"new-{number}"
            restore(archive, new, LATER)
            controllers, days = history(new)
            assert controllers == days >= before
            noted = [record.id for record in read_ledger(new) if isinstance(record, Intent)]
            assert int(noted[-1], 16) >= before  # nothing of what was done before is missing
            last = new / NAME
            assert last.read_bytes().endswith(b"\n")
            assert all(json.loads(line) for line in last.read_bytes().splitlines())
            assert (boots(new) or (b"", 0))[0] == ENGINE
            seen.append((controllers, len(noted)))
    assert len(set(seen)) > 1  # it did go on meanwhile


def test_archives_that_are_kept_in_state_dir_are_in_none(state: Path, tmp_path: Path) -> None:
    for name in ("monday.tar", "tuesday.tar"):
        assert back_up(state, "ridge-07", state / name, MADE) == (FILE_NAME, engine.FILE_NAME, NAME)
    restore(state / "tuesday.tar", state, LATER)
    assert history(state) == (1, 1)


def test_what_was_there_is_kept_beside(state: Path, tmp_path: Path) -> None:
    archive = tmp_path / "backup.tar"
    back_up(state, "ridge-07", archive, MADE)
    with closing(open_database(state)) as connection:
        add_controller(connection, 2)
    _, moved = restore(archive, state, LATER)
    assert moved is not None
    assert moved.parent == state
    assert (history(state), history(moved)) == ((1, 1), (2, 2))
    assert MADE < LATER
    back_up(state, "ridge-07", archive, LATER)
    assert moved.name not in " ".join(members(archive))


def test_boots_go_on_above_what_may_have_been_used(state: Path, tmp_path: Path) -> None:
    archive = tmp_path / "backup.tar"
    back_up(state, "ridge-07", archive, MADE)
    restore(archive, state, LATER)
    assert boots(state) == (ENGINE, 7 + 3600 + 1)
    (state / engine.FILE_NAME).write_bytes(engine.state_text(ENGINE, 100_000))
    restore(archive, state, LATER)
    assert boots(state) == (ENGINE, 100_000)
    assert engine.start_engine(state, 32473, 0.0).boots == 100_001


@pytest.mark.parametrize(("number", "at"), [(7, MADE - 1.0), (engine.MAX_BOOTS - 100, LATER)], ids=["clock", "used up"])
def test_an_engine_whose_boots_cannot_be_told_is_left_out(state: Path, tmp_path: Path, number: int, at: float) -> None:
    archive = tmp_path / "backup.tar"
    (state / engine.FILE_NAME).write_bytes(engine.state_text(ENGINE, number))
    back_up(state, "ridge-07", archive, MADE)
    restore(archive, tmp_path / "new", at)
    assert not (tmp_path / "new" / engine.FILE_NAME).exists()
    assert engine.start_engine(tmp_path / "new", 32473, 0.0).engine_id != ENGINE


def test_nothing_is_restored_below_a_gateway_that_runs(state: Path, tmp_path: Path) -> None:
    archive = tmp_path / "backup.tar"
    back_up(state, "ridge-07", archive, MADE)
    before = {path: path.stat().st_mtime_ns for path in state.iterdir() if not path.name.endswith(BESIDE)}
    with claimed(state) as mine:
        assert mine
        with pytest.raises(BackupError, match="a gateway uses it"):
            restore(archive, state, LATER)
        back_up(state, "ridge-07", tmp_path / "second.tar", MADE)
    assert {path: path.stat().st_mtime_ns for path in before} == before
    restore(archive, state, LATER)


def test_a_second_gateway_is_told(state: Path) -> None:
    with claimed(state), claimed(state) as mine:
        assert not mine
    with claimed(state) as mine:
        assert mine


def test_a_killed_gateway_holds_nothing(state: Path) -> None:
    script = (
        "import sys, pathlib; from gateway.service.state_dir import held\n"
        "with held(pathlib.Path(sys.argv[1])) as mine: print(mine, flush=True); sys.stdin.read()"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", script, str(state)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    with process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"True\n"
        with held(state) as mine:
            assert not mine
        process.kill()
    with held(state) as mine:
        assert mine


def test_a_folder_that_cannot_be_made_stops_no_gateway(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with claimed(tmp_path / "file" / "state") as mine:
        assert mine


@pytest.mark.parametrize(
    "spoil",
    [
        {"../evil": b"x"},
        {"folder/file": b"x"},
        {".hidden": b"x"},
        {MANIFEST: b"{}"},
        {MANIFEST: b"not json"},
        {MANIFEST: b'{"format": 2, "version": "9", "site": "x", "made_at": 0}'},
        {MANIFEST: b'{"format": 1, "version": "9", "site": "x", "made_at": "yesterday"}'},
        {MANIFEST: b'{"format": 1, "version": "9", "site": "x", "made_at": 1e300}'},
        {MANIFEST: b'{"format": 1, "version": "9", "site": "\\u001b[2J", "made_at": 0}'},
        {FILE_NAME: b"SQLite format 3\0" + bytes(5000)},
        {f"{FILE_NAME}-wal": b"pages of another file"},
    ],
    ids=[
        *("out of the folder", "folder", "hidden", "empty manifest", "no manifest", "later format"),
        *("no moment", "no year", "a terminal's command", "damaged history", "working copy"),
    ],
)
def test_a_strange_archive_changes_nothing(state: Path, tmp_path: Path, spoil: dict[str, bytes]) -> None:
    archive = tmp_path / "backup.tar"
    back_up(state, "ridge-07", archive, MADE)
    pack(archive, members(archive) | spoil)
    before = sorted((path.name, path.stat().st_size) for path in state.iterdir())
    with pytest.raises(BackupError):
        restore(archive, state, LATER)
    assert sorted((path.name, path.stat().st_size) for path in state.iterdir()) == before
    assert not (tmp_path / "evil").exists()


def test_something_that_is_no_archive_is_said(state: Path, tmp_path: Path) -> None:
    back_up(state, "ridge-07", tmp_path / "backup.tar", MADE)
    whole = (tmp_path / "backup.tar").read_bytes()
    for data in (b"hello", b"", gzip.compress(whole), whole[:5000]):
        (tmp_path / "no.tar").write_bytes(data)
        with pytest.raises(BackupError, match=r"no\.tar: is no whole backup of a gateway: "):
            restore(tmp_path / "no.tar", state, LATER)
    with pytest.raises(BackupError, match=r"missing\.tar"):
        restore(tmp_path / "missing.tar", state, LATER)


def test_a_link_in_an_archive_leads_nowhere(state: Path, tmp_path: Path) -> None:
    archive = tmp_path / "backup.tar"
    back_up(state, "ridge-07", archive, MADE)
    (tmp_path / "link").symlink_to("/etc/passwd")
    with tarfile.open(archive, "a") as tar:
        tar.add(tmp_path / "link", arcname="writes.jsonl.1")
    with pytest.raises(BackupError, match="does not belong"):
        restore(archive, state, LATER)


def test_a_backup_that_cannot_be_written_leaves_nothing(state: Path, tmp_path: Path) -> None:
    with pytest.raises(BackupError):
        back_up(state, "ridge-07", tmp_path / "missing" / "backup.tar", MADE)
    with pytest.raises(BackupError):
        back_up(tmp_path / "no state", "ridge-07", tmp_path / "backup.tar", MADE)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["state"]


def test_why_there_is_no_backup_is_said(state: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for folder in (Path(), Path("/"), tmp_path):
        with pytest.raises(BackupError, match="is a folder; an archive is a file"):
            back_up(state, "ridge-07", folder, MADE)
    with pytest.raises(BackupError, match=r"No such file or directory: .*no state"):
        back_up(tmp_path / "no state", "ridge-07", tmp_path / "backup.tar", MADE)


def ends_amid(command: str, archive: Path, state: Path, number: signal.Signals) -> None:
    """Run `backup` or `restore`, and have it get a signal while its copies are there and what it makes is not."""
    config = state.parent / "site.toml"
    minimal = (Path(__file__).parents[2] / "config" / "minimal.toml").read_text()
    config.write_text(f'state_dir = "{state}"\n{minimal}')
    code = (
        "import os, sys\nfrom gateway.cli.main import main\nfrom gateway.service import backup\n"
        f"backup.os.fsync = lambda _fd: os.kill(os.getpid(), {int(number)})\n"
        f"sys.argv = ['prostar-gateway', {command!r}, '-c', {str(config)!r}, {str(archive)!r}]\nmain()\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    expected = -number if number is signal.SIGKILL else 128 + number
    assert (done.returncode, done.stderr) == (expected, "")
    config.unlink()


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGKILL])
def test_of_a_backup_that_was_ended_nothing_stays_when_there_is_another(
    state: Path, tmp_path: Path, number: signal.Signals
) -> None:
    ends_amid("backup", tmp_path / "monday.tar", state, number)
    left = [name for name in names(tmp_path) if name.startswith(".prostar-gateway-unfinished-")]
    assert sorted(left) == [name for name in names(tmp_path) if name != "state"]
    assert len(left) == (number is signal.SIGKILL)
    back_up(state, "ridge-07", tmp_path / "tuesday.tar", MADE)
    assert names(tmp_path) == ["state", "tuesday.tar"]
    assert "history.sqlite3" in members(tmp_path / "tuesday.tar")


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_of_a_restore_that_was_ended_nothing_stays_when_there_is_another(
    state: Path, tmp_path: Path, number: signal.Signals
) -> None:
    back_up(state, "ridge-07", tmp_path / "backup.tar", MADE)
    before = names(state)
    ends_amid("restore", tmp_path / "backup.tar", state, number)
    assert len(names(state)) == len(before) + (number is signal.SIGKILL)
    _, moved = restore(tmp_path / "backup.tar", state, LATER)
    assert moved is not None
    assert [path.name for path in state.iterdir() if path.is_dir()] == [moved.name]


def test_a_backup_does_not_take_another_ones_folder_away(state: Path, tmp_path: Path) -> None:
    work = tmp_path / ".prostar-gateway-unfinished-another"
    work.mkdir()
    with held(work) as mine:
        assert mine
        back_up(state, "ridge-07", tmp_path / "backup.tar", MADE)
        assert work.exists()
    back_up(state, "ridge-07", tmp_path / "backup.tar", MADE)
    assert names(tmp_path) == ["backup.tar", "state"]


@pytest.mark.skipif(os.geteuid() != 0, reason="only root gives files away")
def test_restored_files_belong_to_whom_the_folder_belongs(state: Path, tmp_path: Path) -> None:
    archive, new = tmp_path / "backup.tar", tmp_path / "new"
    back_up(state, "ridge-07", archive, MADE)
    new.mkdir()
    os.chown(new, 61234, 61234)
    restore(archive, new, LATER)
    restore(archive, new, LATER)  # and the folder of what was there before
    assert {(path.stat().st_uid, path.stat().st_gid) for path in new.iterdir()} == {(61234, 61234)}


def damage(path: Path) -> bytes:
    """Overwrite what is behind the head of a database, so that it still says that it is one; gives its content."""
    path.write_bytes(path.read_bytes()[:100] + b"\xff" * 8192)
    return path.read_bytes()


def test_what_was_set_aside_as_damaged_is_kept_as_it_is(state: Path, tmp_path: Path) -> None:
    """Its days may still be rescued, and one damaged file long ago is no reason to have no backup of the others."""
    content = damage(state / FILE_NAME)
    aside = set_aside(state / FILE_NAME, "a test")
    aside.with_name(aside.name + "-wal").write_bytes(b"what was not yet in it")
    with closing(open_database(state)) as connection:
        add_controller(connection, 1)
    archive = tmp_path / "backup.tar"
    back_up(state, "ridge-07", archive, MADE)
    assert members(archive)[aside.name] == content
    assert {path.name for path in state.iterdir()} >= {aside.name, f"{aside.name}-wal"}
    assert not aside.with_name(aside.name + "-shm").exists()  # it was not opened
    restore(archive, tmp_path / "new", LATER)
    assert history(tmp_path / "new") == (1, 1)
    assert (tmp_path / "new" / aside.name).read_bytes() == content
    assert (tmp_path / "new" / f"{aside.name}-wal").read_bytes() == b"what was not yet in it"


@pytest.mark.parametrize("page", [None, 3], ids=["all of it", "a page that copying does not look into"])
def test_a_history_that_is_damaged_now_is_named_with_what_to_do(state: Path, tmp_path: Path, page: int | None) -> None:
    if page is None:
        damage(state / FILE_NAME)
    else:
        whole = (state / FILE_NAME).read_bytes()
        size = int.from_bytes(whole[16:18])
        (state / FILE_NAME).write_bytes(whole[: page * size] + b"\xff" * size + whole[(page + 1) * size :])
    archive = tmp_path / "backup.tar"
    archive.write_bytes(b"that of yesterday")
    with pytest.raises(BackupError, match=rf"{state / FILE_NAME}: .*start the gateway, which sets it aside"):
        back_up(state, "ridge-07", archive, MADE)
    assert archive.read_bytes() == b"that of yesterday"
