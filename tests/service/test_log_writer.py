"""F83 in one process: whoever reads the log, or does not, nobody waits for it."""

from __future__ import annotations

import fcntl
import logging
import os
import select
import socket
import time
from collections.abc import Iterator

import pytest

from gateway.service import log_writer as module
from gateway.service.log_writer import LogWriter, journal_reads
from gateway.service.logs import EventFormatter


class Pipe:
    """A pipe and a writer on it."""

    def __init__(self, *, journal: bool = False) -> None:
        self.reading, self.writing = os.pipe()
        fcntl.fcntl(self.writing, fcntl.F_SETPIPE_SZ, 4096)
        self.writer = LogWriter(self.writing, journal=journal)
        self.writer.setFormatter(EventFormatter())

    def log(self, message: str, level: int = logging.INFO) -> None:
        self.writer.handle(logging.LogRecord("gateway.x", level, "", 0, message, (), None))

    def read(self) -> list[str]:
        self.writer.flush()
        os.set_blocking(self.reading, False)
        try:
            return os.read(self.reading, 1 << 20).decode().splitlines()
        except BlockingIOError:
            return []

    def read_all(self) -> list[str]:
        """Until the writer has nothing more."""
        data = b""
        while self.writer._queue or self.writer._writing:
            if select.select([self.reading], [], [], 0.05)[0]:  # it may have just written its last
                data += os.read(self.reading, 1 << 20)
        return data.decode().splitlines() + self.read()


@pytest.fixture
def pipe() -> Iterator[Pipe]:
    one = Pipe()
    yield one
    os.close(one.reading)
    one.writer.close()
    os.close(one.writing)


def test_lines_come_out_in_order(pipe: Pipe) -> None:
    for number in range(20):
        pipe.log(f"event=x n={number}")
    assert [line.split("n=")[1] for line in pipe.read()] == [str(number) for number in range(20)]


def test_without_a_reader_nobody_waits_and_what_is_dropped_is_counted_and_told(
    pipe: Pipe, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "LINES", 100)
    for number in range(1000):
        pipe.log(f"event=x n={number} {'.' * 100}")
    assert 800 <= pipe.writer.stats.dropped < 900 + 1
    lines = pipe.read_all()
    dropped = [line for line in lines if "level=warning event=log_dropped count=" in line]
    assert sum(int(line.split("count=")[1]) for line in dropped) == pipe.writer.stats.dropped  # told once, as it goes
    assert len(lines) - len(dropped) == 1000 - pipe.writer.stats.dropped
    pipe.log("event=after")
    assert pipe.read()[-1].endswith("event=after")


def test_a_flush_gives_up(pipe: Pipe, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "FLUSH_S", 0.1)
    for _ in range(100):
        pipe.log("event=x " + "." * 100)
    began = time.monotonic()
    pipe.writer.flush()
    assert 0.05 < time.monotonic() - began < 30.0


def test_a_closed_pipe_disturbs_nobody() -> None:
    pipe = Pipe()
    os.close(pipe.reading)
    for _ in range(10):
        pipe.log("event=x")
    pipe.writer.close()
    assert pipe.writer.stats.dropped == 10
    os.close(pipe.writing)


def test_the_journal_is_told_priorities_of_every_line() -> None:
    pipe = Pipe(journal=True)
    levels = (logging.DEBUG, logging.INFO, logging.WARNING, logging.ERROR, logging.CRITICAL)
    for level in levels:
        pipe.log("event=x", level)
    found = pipe.read()
    assert [line[:3] for line in found] == ["<7>", "<6>", "<4>", "<3>", "<2>"]
    record = logging.LogRecord("g", logging.ERROR, "", 0, "event=task_failed", (), None)
    try:
        _ = 1 / int("0")
    except ZeroDivisionError as error:
        record.exc_info = (type(error), error, error.__traceback__)
    pipe.writer.handle(record)
    lines = pipe.read()
    assert len(lines) > 3
    assert all(line.startswith("<3>") for line in lines)
    os.close(pipe.reading)
    pipe.writer.close()
    os.close(pipe.writing)


def test_only_the_descriptor_that_systemd_named_is_the_journal() -> None:
    one, other = socket.socketpair()
    with one, other:
        found = os.fstat(one.fileno())
        environment = {"JOURNAL_STREAM": f"{found.st_dev}:{found.st_ino}"}
        assert journal_reads(one.fileno(), environment)
        assert not journal_reads(other.fileno(), environment)
        assert not journal_reads(one.fileno(), {})
    assert not journal_reads(10_000, environment)
