"""The log: one line an event whatever a peer sent, and one form for all."""

from __future__ import annotations

import io
import logging
import sys
from collections.abc import Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.service.logs import EventFormatter, Level, set_up_logging


def formatted(message: str, *args: object, name: str = "gateway.x") -> str:
    return EventFormatter().format(logging.LogRecord(name, logging.WARNING, "", 0, message, args, None))


@pytest.fixture
def root() -> Iterator[logging.Logger]:
    logger = logging.getLogger()
    handlers, level, raises = logger.handlers[:], logger.level, logging.raiseExceptions
    yield logger
    logger.handlers[:] = handlers
    logger.setLevel(level)
    logging.raiseExceptions = raises


@pytest.mark.parametrize(
    ("message", "expected"),
    [
        ("event=line_down line=a", "event=line_down line=a"),
        ("write_refused peer=1.2.3.4 unit=1", "event=write_refused peer=1.2.3.4 unit=1"),
        ("stopped", "event=stopped"),
        ('Task "x" was destroyed', 'event=log logger=gateway.x message="Task \\"x\\" was destroyed"'),
    ],
)
def test_every_line_has_time_level_and_event(message: str, expected: str) -> None:
    line = formatted(message)
    assert line.endswith(f"Z level=warning {expected}")
    assert line.startswith("time=")


@given(st.text(max_size=200))
def test_an_event_is_one_line_whatever_is_in_it(text: str) -> None:
    line = formatted('event=x peer="%s"', text)
    assert len(line.splitlines()) == 1
    assert line.isprintable() or not any(ord(character) < 32 for character in line)


def test_a_traceback_follows_its_line() -> None:
    record = logging.LogRecord("g", logging.ERROR, "", 0, "event=task_failed", (), None)
    try:
        _ = 1 / int("0")
    except ZeroDivisionError:
        record.exc_info = sys.exc_info()
    first, *rest = EventFormatter().format(record).splitlines()
    assert first.endswith("event=task_failed")
    assert rest[-1] == "ZeroDivisionError: division by zero"


def test_levels_choose_what_is_written(root: logging.Logger) -> None:
    stream = io.StringIO()
    set_up_logging(Level.WARNING, stream)
    logging.getLogger("gateway.x").info("event=no")
    logging.getLogger("gateway.x").warning("event=yes")
    assert [line.split()[-1] for line in stream.getvalue().splitlines()] == ["event=yes"]


def test_a_log_that_cannot_be_written_disturbs_nobody(root: logging.Logger, capsys: pytest.CaptureFixture[str]) -> None:
    stream = io.StringIO()
    set_up_logging(Level.INFO, stream)
    stream.close()
    logging.getLogger("gateway.x").warning("event=lost")
    assert capsys.readouterr().err == ""
