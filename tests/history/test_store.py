from __future__ import annotations

import errno
import json
import os
import sqlite3
import subprocess
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path

import pytest

from gateway.errors import HistoryError
from gateway.history.database import FILE_NAME, open_database, open_for_reading
from gateway.history.dates import HOUR_S
from gateway.history.ring import Why
from gateway.history.store import Store
from tests.history.blocks import EMPTY, HI_LO, LAYOUT, WALL, block, full_ring, raw, seen

HOURS = [1000 + 24 * day for day in range(100)]
LIVE = HOURS[-1] + 5
RING = full_ring(HOURS)


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    with closing(Store(tmp_path, session=1)) as opened:
        yield opened


def rows(directory: Path, query: str) -> list[tuple[object, ...]]:
    with closing(sqlite3.connect(directory / FILE_NAME)) as connection:
        return connection.execute(query).fetchall()


def test_a_ring_is_stored_with_words_values_and_dates(tmp_path: Path, store: Store) -> None:
    kept = store.keep_ring(seen(LIVE), LAYOUT, RING)
    assert (kept.new_days, kept.days, kept.apart, kept.is_new, kept.replaced) == (100, 100, 0, True, None)
    assert kept.controller.position is not None
    assert (kept.controller.position.slot, kept.controller.position.words) == (99, RING[99])
    found = rows(tmp_path, "SELECT hourmeter, slot, words, word_order, fields, written_wall, error_s FROM day")
    assert [(hour, slot, words) for hour, slot, words, *_ in found] == [(HOURS[n], n, RING[n]) for n in range(100)]
    *_, order, fields, written, error_s = found[-1]
    assert order == HI_LO.value
    assert written == WALL - 5 * HOUR_S
    assert isinstance(error_s, float)
    assert HOUR_S < error_s < 2 * HOUR_S
    assert isinstance(fields, str)
    assert json.loads(fields)["float_time"] == 90 * 60


def test_storing_the_same_again_changes_nothing(tmp_path: Path, store: Store) -> None:
    store.keep_ring(seen(LIVE), LAYOUT, RING)
    before = rows(tmp_path, "SELECT * FROM day")
    kept = store.keep_ring(seen(LIVE + 50, wall=WALL + 50 * HOUR_S), LAYOUT, RING)
    assert (kept.new_days, kept.days) == (0, 100)
    assert rows(tmp_path, "SELECT * FROM day") == before


def test_a_block_that_was_read_while_it_was_written_is_healed(tmp_path: Path, store: Store) -> None:
    torn = {**RING, 99: block(HOURS[99], low_v=1.0)}
    store.keep_ring(seen(LIVE), LAYOUT, torn)
    kept = store.keep_ring(seen(LIVE + 1), LAYOUT, RING)
    assert (kept.new_days, kept.days, kept.apart) == (0, 100, 0)
    (found,) = rows(tmp_path, f"SELECT words, fields FROM day WHERE hourmeter = {HOURS[99]}")
    assert found[0] == RING[99]
    assert json.loads(str(found[1]))["battery_voltage_minimum"] != 1.0


def test_a_second_day_with_a_known_hourmeter_is_kept_apart(store: Store) -> None:
    first = store.keep_ring(seen(LIVE), LAYOUT, RING)
    tie = {100: block(HOURS[99], low_v=11.0), 101: block(HOURS[99] + 4)}
    kept = store.keep_newer(seen(LIVE), LAYOUT, first.controller, tie)
    assert (kept.new_days, kept.days, kept.apart) == (1, 101, 1)
    assert [(found.slot, found.why) for found in kept.new_apart] == [(100, Why.TIE)]
    again = store.keep_newer(seen(LIVE), LAYOUT, kept.controller, {})
    assert (again.new_apart, again.apart) == ((), 1)


def test_a_tie_at_the_end_does_not_move_the_position(store: Store) -> None:
    first = store.keep_ring(seen(LIVE), LAYOUT, RING)
    kept = store.keep_newer(seen(LIVE), LAYOUT, first.controller, {100: block(HOURS[99], low_v=11.0)})
    assert kept.controller.position == first.controller.position


def test_blocks_apart_are_told_once(store: Store) -> None:
    odd = {**RING, 50: block(7)}
    kept = store.keep_ring(seen(LIVE), LAYOUT, odd)
    assert [(found.hourmeter, found.why) for found in kept.new_apart] == [(7, Why.ORDER)]
    assert store.keep_ring(seen(LIVE), LAYOUT, odd).new_apart == ()


def test_a_block_that_turns_out_to_be_a_day_is_not_apart_any_more(store: Store) -> None:
    early = {**RING, 100: block(HOURS[-1] + 48)}
    assert store.keep_ring(seen(LIVE), LAYOUT, early).apart == 1  # ahead of an hourmeter that hung
    kept = store.keep_ring(seen(LIVE + 48), LAYOUT, early)
    assert (kept.days, kept.apart) == (101, 0)


def test_a_ring_that_was_not_read_whole_is_read_again(store: Store) -> None:
    part = {slot: words for slot, words in RING.items() if slot != 40}
    kept = store.keep_ring(seen(LIVE), LAYOUT, part, whole=False)
    assert (kept.days, kept.controller.position) == (99, None)
    plan = store.plan(seen(LIVE))
    assert plan.controller is not None
    assert plan.position is None
    again = store.keep_ring(seen(LIVE), LAYOUT, RING)
    assert (again.new_days, again.days, again.is_new) == (1, 100, False)


def test_what_is_staged_is_for_the_same_controller_only(store: Store) -> None:
    store.stage(seen(LIVE), {0: RING[0]}, first=True)
    store.stage(seen(LIVE + 1), {1: RING[1]}, first=False)
    assert store.plan(seen(LIVE + 1)).staged == {0: RING[0], 1: RING[1]}
    assert store.plan(seen(LIVE)).staged == {}  # its hourmeter is behind
    assert store.plan(seen(LIVE + 2, product="PS-MPPT-40")).staged == {}
    assert store.plan(seen(LIVE + 2, serial="17340001")).staged == {}
    store.stage(seen(LIVE + 2), {5: RING[5]}, first=True)
    assert store.plan(seen(LIVE + 2)).staged == {5: RING[5]}
    store.keep_ring(seen(LIVE + 2), LAYOUT, RING)
    assert store.plan(seen(LIVE + 2)).staged == {}


def test_days_without_a_clock_are_dated_when_there_is_one(tmp_path: Path, store: Store) -> None:
    kept = store.keep_ring(seen(LIVE, wall=1000.0), LAYOUT, RING)
    assert rows(tmp_path, "SELECT count(written_wall), count(*) FROM day") == [(0, 100)]
    store.keep_newer(seen(LIVE + 2), LAYOUT, kept.controller, {})
    assert rows(tmp_path, "SELECT count(written_wall) FROM day") == [(100,)]
    assert rows(tmp_path, "SELECT max(written_wall) FROM day") == [(WALL - 7 * HOUR_S,)]


def dates(directory: Path) -> dict[object, float]:
    return {row[0]: float(str(row[1])) for row in rows(directory, "SELECT hourmeter, written_wall FROM day")}


def test_a_clock_that_is_set_moves_the_dates_of_this_run_only(tmp_path: Path, store: Store) -> None:
    kept = store.keep_ring(seen(LIVE), LAYOUT, RING)
    later = Store(tmp_path, session=2)
    with closing(later):
        new = {100: block(HOURS[-1] + 24)}
        later.keep_newer(seen(LIVE + 24, wall=WALL + 24 * HOUR_S), LAYOUT, kept.controller, new)
        before = dates(tmp_path)
        assert later.shift([kept.controller.key], 5000.0) == 1
        after = dates(tmp_path)
    new_hour = HOURS[-1] + 24
    moved = {hour: at for hour, at in after.items() if at != before[hour]}
    assert moved == {new_hour: pytest.approx(before[new_hour] + 5000.0)}
    assert moved[new_hour] == pytest.approx(WALL + 19 * HOUR_S + 5000.0, abs=60)
    assert rows(tmp_path, "SELECT look_wall FROM controller") == [(WALL + 24 * HOUR_S + 5000.0,)]


def test_a_clock_that_is_set_moves_what_nobody_was_told_of_any_more(tmp_path: Path, store: Store) -> None:
    """A keeper that is ended by a reload while its harvest is stored learns no key."""
    store.keep_ring(seen(LIVE), LAYOUT, RING)
    before = dates(tmp_path)
    assert store.shift((), 5000.0) == 100
    assert dates(tmp_path) == {hour: pytest.approx(at + 5000.0) for hour, at in before.items()}
    assert rows(tmp_path, "SELECT look_wall FROM controller") == [(WALL + 5000.0,)]


def test_identities_are_unique(tmp_path: Path, store: Store) -> None:
    for n in range(3):
        store.keep_ring(seen(LIVE - n), LAYOUT, full_ring(HOURS[: 90 - n], volts=12.0 - n), whole=True)
    assert rows(tmp_path, "SELECT identity FROM controller ORDER BY key") == [
        ("shelter-a/array-1",),
        ("shelter-a/array-1/2",),
        ("shelter-a/array-1/3",),
    ]


def test_nothing_of_a_harvest_is_stored_when_a_part_cannot_be(
    tmp_path: Path, store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    store.stage(seen(LIVE), raw(RING), first=True)

    def broken(*_arguments: object) -> bool:
        raise sqlite3.OperationalError("disk I/O error")

    with monkeypatch.context() as patch:
        patch.setattr(Store, "_insert_apart", broken)
        with pytest.raises(HistoryError, match="disk I/O error"):
            store.keep_ring(seen(LIVE), LAYOUT, {**RING, 50: block(7)})
    assert rows(tmp_path, "SELECT count(*) FROM day") == [(0,)]
    assert len(store.plan(seen(LIVE)).staged) == 100
    assert store.keep_ring(seen(LIVE), LAYOUT, RING).days == 100


# The file


def test_the_file_is_wal_and_synced(tmp_path: Path) -> None:
    with closing(open_database(tmp_path / "new" / "folder")) as connection:
        assert connection.execute("PRAGMA journal_mode").fetchone() == ("wal",)
        assert connection.execute("PRAGMA synchronous").fetchone() == (2,)


def test_staging_leaves_the_sync_on(store: Store) -> None:
    store.stage(seen(LIVE), {0: EMPTY}, first=True)
    assert store._db.execute("PRAGMA synchronous").fetchone() == (2,)


@pytest.mark.parametrize("damage", ["garbage", "torn page", "header"])
def test_a_damaged_file_is_set_aside_and_said(tmp_path: Path, damage: str, caplog: pytest.LogCaptureFixture) -> None:
    with closing(Store(tmp_path, 1)) as store:
        store.keep_ring(seen(LIVE), LAYOUT, RING)
    path = tmp_path / FILE_NAME
    data = bytearray(path.read_bytes())
    if damage == "garbage":
        data = bytearray(b"no database at all " * 100)
    elif damage == "header":
        data[:16] = bytes(16)
    else:
        for page in range(4096, len(data), 4096):
            data[page : page + 100] = b"\xa5" * 100
    path.write_bytes(data)
    with closing(Store(tmp_path, 2)) as store:
        assert store.plan(seen(LIVE)).controller is None
        assert store.keep_ring(seen(LIVE), LAYOUT, RING).days == 100
    (aside,) = tmp_path.glob(f"{FILE_NAME}.corrupt-*")
    assert aside.read_bytes() == data
    assert "event=history_set_aside" in caplog.text
    assert str(aside) in caplog.text


def test_damage_that_shows_later_is_set_aside_too(tmp_path: Path, store: Store) -> None:
    store.keep_ring(seen(LIVE), LAYOUT, RING)
    store.rescue(HistoryError("corrupt", "database disk image is malformed"))
    assert store.plan(seen(LIVE)).controller is None
    assert len(list(tmp_path.glob(f"{FILE_NAME}.corrupt-*"))) >= 1
    assert store.keep_ring(seen(LIVE), LAYOUT, RING).days == 100


def test_two_files_of_one_second_get_two_names(tmp_path: Path) -> None:
    for _ in range(3):
        (tmp_path / FILE_NAME).write_bytes(b"nonsense" * 1000)
        open_database(tmp_path).close()
    assert len(list(tmp_path.glob(f"{FILE_NAME}.corrupt-*"))) == 3


def test_a_file_of_a_later_version_is_left_alone(tmp_path: Path) -> None:
    open_database(tmp_path).close()
    with closing(sqlite3.connect(tmp_path / FILE_NAME)) as connection:
        connection.execute("PRAGMA user_version = 99")
        connection.commit()
    data = (tmp_path / FILE_NAME).read_bytes()
    for opener in (open_database, open_for_reading):
        with pytest.raises(HistoryError, match="later version") as caught:
            opener(tmp_path)
        assert caught.value.kind == "newer"
    assert (tmp_path / FILE_NAME).read_bytes() == data


def test_a_database_of_something_else_is_left_alone(tmp_path: Path) -> None:
    with closing(sqlite3.connect(tmp_path / FILE_NAME)) as connection:
        connection.execute("CREATE TABLE mine (x)")
    with pytest.raises(HistoryError, match="something else"):
        open_database(tmp_path)
    assert rows(tmp_path, "SELECT name FROM sqlite_schema") == [("mine",)]


def test_a_directory_that_cannot_be_made_is_said_by_name(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(HistoryError, match="file/state") as caught:
        Store(tmp_path / "file" / "state", 1)
    assert caught.value.kind == "unwritable"


@contextmanager
def mounted(folder: Path, options: str) -> Iterator[None]:
    """A file system of memory on a folder; skips where this may not be mounted."""
    if os.geteuid() != 0:
        pytest.skip("only root can mount")
    done = subprocess.run(["mount", "-t", "tmpfs", "-o", options, "tmpfs", folder], capture_output=True, check=False)
    if done.returncode != 0:
        pytest.skip(f"cannot mount here: {done.stderr.decode()}")
    try:
        yield
    finally:
        subprocess.run(["umount", "--lazy", folder], check=True)


def fill(path: Path) -> None:
    """Use up the file system."""
    fd = os.open(path, os.O_CREAT | os.O_WRONLY)
    try:
        with suppress(OSError):
            while os.write(fd, bytes(4096)):
                pass
    finally:
        os.close(fd)


def test_a_full_disk_is_said_and_costs_nothing_that_was_stored(tmp_path: Path) -> None:  # F80
    with mounted(tmp_path, "size=400k"), closing(Store(tmp_path, 1)) as store:
        kept = store.keep_ring(seen(LIVE), LAYOUT, full_ring(HOURS[:50]))
        filler = tmp_path / "filler"
        fill(filler)
        with pytest.raises(HistoryError) as caught:
            store.keep_ring(seen(LIVE), LAYOUT, RING)
        assert caught.value.kind == "full"
        assert rows(tmp_path, "SELECT count(*) FROM day") == [(50,)]
        filler.unlink()
        assert store.keep_ring(seen(LIVE), LAYOUT, RING).controller.key == kept.controller.key
        assert rows(tmp_path, "SELECT count(*) FROM day") == [(100,)]


def test_a_read_only_directory_is_said_and_can_still_be_read(tmp_path: Path) -> None:  # F80
    with mounted(tmp_path, "size=1m"):
        with closing(Store(tmp_path, 1)) as store:
            store.keep_ring(seen(LIVE), LAYOUT, RING)
        subprocess.run(["mount", "-o", "remount,ro", tmp_path], check=True)
        with pytest.raises(HistoryError) as caught:
            Store(tmp_path, 2)
        assert caught.value.kind == "unwritable"
        with closing(open_for_reading(tmp_path)) as connection:
            assert connection.execute("SELECT count(*) FROM day").fetchone() == (100,)


def test_a_directory_that_may_not_be_read_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(_path: Path) -> bool:
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(Path, "is_file", refused)
    with pytest.raises(HistoryError, match=r"history\.sqlite3: Permission denied"):
        open_for_reading(tmp_path)
