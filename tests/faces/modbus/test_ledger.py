"""The ledger's files: what a kill or a full disk leaves, and how far they grow."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from gateway.core.write_ledger import Book, Fate, Intent, Record, Verdict, encode, entries
from gateway.devices.model import Space
from gateway.faces.modbus.ledger import NAME, LedgerFile, read_ledger

NOW = 1_800_000_000.0


def intent(number: int) -> Intent:
    address = 0xE000 + number % 7
    return Intent(
        f"{number}", NOW + number, "192.0.2.7", None, 11, "a", "p", Space.REGISTERS, address, 1, 2, wears=True
    )


def written(number: int) -> Verdict:
    return Verdict(f"{number}", NOW + number, Fate.WRITTEN)


def opened(folder: Path, **options: int) -> LedgerFile:
    ledger = LedgerFile(folder, **options)
    ledger.open()
    return ledger


def known(folder: Path) -> Book:
    """What a gateway that starts now knows."""
    ledger = opened(folder)
    return ledger.book


def test_what_was_added_is_there_after_the_next_start(tmp_path: Path) -> None:
    ledger = opened(tmp_path / "deep" / "er")
    ledger.append([intent(1), intent(2)])
    ledger.append([written(1)])
    assert (tmp_path / "deep" / "er" / NAME).stat().st_mode & 0o007 == 0, "not for everybody"
    book = known(tmp_path / "deep" / "er")
    assert list(book.open) == ["2"]
    assert sum(map(len, book.worn.values())) == 2


@pytest.mark.parametrize("cut", [1, 5, 40])
def test_a_line_cut_off_by_a_power_failure_hides_no_other(tmp_path: Path, cut: int) -> None:
    ledger = opened(tmp_path)
    ledger.append([intent(1), written(1), intent(2)])
    path = tmp_path / NAME
    path.write_bytes(path.read_bytes()[:-cut])
    ledger = opened(tmp_path)
    ledger.append([intent(3)])
    assert [entry.intent.id for entry in entries(read_ledger(tmp_path))] == (
        ["1", "2", "3"] if cut == 1 else ["1", "3"]
    )


def test_its_size_is_bounded_and_what_is_needed_is_carried_on(tmp_path: Path) -> None:
    ledger = opened(tmp_path, max_bytes=4000, keep=3)
    ledger.append([intent(0)])  # never settled
    for number in range(1, 200):
        ledger.append([intent(number), written(number)])
    files = sorted(path.name for path in tmp_path.iterdir())
    assert files == [NAME, f"{NAME}.1", f"{NAME}.2", f"{NAME}.3"]
    assert all((tmp_path / name).stat().st_size < 20_000 for name in files)
    book = known(tmp_path)
    assert list(book.open) == ["0"]
    assert sum(map(len, book.worn.values())) == 200
    found = [int(entry.intent.id) for entry in entries(read_ledger(tmp_path))]
    assert found[-1] == 199
    assert len(found) == len(set(found))


def fill(ledger: LedgerFile, first: int, count: int) -> int:
    """Note so many writes; gives the number of the first that could not be noted, or of the next."""
    for number in range(first, first + count):
        try:
            ledger.append([intent(number), written(number)])
        except OSError:
            return number
    return first + count


@pytest.mark.parametrize("restarted", [False, True])
@pytest.mark.parametrize("failing", ["replace", "fsync"])
@pytest.mark.parametrize("at", range(1, 6))
def test_a_rotation_that_breaks_off_anywhere_loses_nothing(
    tmp_path: Path, at: int, failing: str, restarted: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    ledger = opened(tmp_path, max_bytes=2000, keep=2)
    number = fill(ledger, 0, 40)
    with monkeypatch.context() as patch:
        _fail(patch, failing, at)
        broken = fill(ledger, number, 50)
    assert broken < number + 50
    assert sum(map(len, known(tmp_path).worn.values())) == broken
    if restarted:
        ledger = opened(tmp_path, max_bytes=2000, keep=2)
    number = fill(ledger, broken, 30)
    assert number == broken + 30, "it goes on"
    assert sum(map(len, known(tmp_path).worn.values())) == number
    assert len(list(tmp_path.iterdir())) == 3


def _fail(patch: pytest.MonkeyPatch, what: str, at: int) -> None:
    """Let the `at`-th call from now fail, as if the disk had gone."""
    left = [at]

    def failing(real: object) -> object:
        def call(*arguments: object) -> object:
            left[0] -= 1
            if left[0] <= 0:
                raise OSError("broken off")
            return real(*arguments)  # type: ignore[operator]  # it is the function that was there

        return call

    if what == "replace":
        patch.setattr(Path, "replace", failing(Path.replace))
    else:
        patch.setattr(os, "fsync", failing(os.fsync))


WRITER = textwrap.dedent(
    """
    import sys
    from pathlib import Path
    from tests.faces.modbus.test_ledger import intent, opened, written
    ledger = opened(Path(sys.argv[1]), max_bytes=3000, keep=200)
    for number in range(100000):
        ledger.append([intent(number)])
        print(number, flush=True)
        ledger.append([written(number)])
    """
)


@pytest.mark.parametrize("after", [1, 7, 33, 60])
def test_after_kill_9_every_intent_that_was_told_of_is_there(tmp_path: Path, after: int) -> None:
    process = subprocess.Popen(
        [sys.executable, "-c", WRITER, str(tmp_path)], stdout=subprocess.PIPE, cwd=Path(__file__).parents[3], text=True
    )
    assert process.stdout is not None
    with process, process.stdout as lines:
        told = [int(lines.readline()) for _ in range(after)]
        process.send_signal(signal.SIGKILL)
        told += [int(line) for line in lines if line.endswith("\n")]
    found = [int(entry.intent.id) for entry in entries(read_ledger(tmp_path))]
    assert found[: len(told)] == told
    assert len(found) <= len(told) + 1
    book = known(tmp_path)
    assert book.skipped <= 1
    assert set(map(int, book.open)) <= {found[-1]}


def test_files_of_a_later_version_are_read_as_far_as_they_are_understood(tmp_path: Path) -> None:
    later = b'{"approved":"x","at":"2040-01-01T00:00:00.000Z"}\n'
    (tmp_path / NAME).write_bytes(encode(intent(1)) + later + encode(written(1)))
    records: list[Record] = list(read_ledger(tmp_path))
    assert records == [intent(1), written(1)]
    assert known(tmp_path).skipped == 1
