"""The log: one line an event whatever a peer sent, and one form for all."""

from __future__ import annotations

import ast
import io
import json
import logging
import os
import re
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.service.log_writer import LogWriter
from gateway.service.logs import EventFormatter, Form, JsonFormatter, Level, Log, set_up_logging


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
    set_up_logging(Level.WARNING, Form.TEXT, logging.StreamHandler(stream))
    logging.getLogger("gateway.x").info("event=no")
    logging.getLogger("gateway.x").warning("event=yes")
    assert [line.split()[-1] for line in stream.getvalue().splitlines()] == ["event=yes"]


def as_json(message: str, *args: object) -> dict[str, object]:
    record = logging.LogRecord("gateway.x", logging.WARNING, "", 0, message, args, None)
    (line,) = JsonFormatter().format(record).splitlines()
    found = json.loads(line)
    assert list(found)[:3] == ["time", "level", "event"]
    assert isinstance(found, dict)
    return {key: value for key, value in found.items() if key not in {"time", "level"}}


@pytest.mark.parametrize(
    ("message", "expected"),
    [
        ("event=line_down line=a", {"event": "line_down", "line": "a"}),
        ("event=x n=3 s=0.5 id=007 big=12345678901234567890 word=0x12",
         {"event": "x", "n": 3, "s": 0.5, "id": "007", "big": "12345678901234567890", "word": "0x12"}),
        ('event=x error="it said \\"no\\"" tries=2', {"event": "x", "error": 'it said "no"', "tries": 2}),
        ('event=x path="C:\\x" n=1', {"event": "x", "path": "C:\\x", "n": 1}),
        ("event=x empty= n=1", {"event": "x", "empty": "", "n": 1}),
        ("no event at all", {"event": "log", "logger": "gateway.x", "message": "no event at all"}),
    ],
)  # fmt: skip
def test_json_has_the_keys_of_the_event(message: str, expected: dict[str, object]) -> None:
    assert as_json(message) == expected


@pytest.mark.parametrize("name", ["shelter a", 'the "old" line', "C:\\x y", "a=b c=d", '"', "ends in \\", "a\tb"])
@pytest.mark.parametrize(
    ("message", "quoted"), [("event=line_down line=%s n=%d", False), ('event=x n=%d of="100%%" line="%s"', True)]
)
def test_a_name_is_whole_whatever_is_in_it(name: str, message: str, quoted: bool) -> None:
    found = as_json(message, *((3, name) if quoted else (name, 3)))
    assert (found["line"], found["n"]) == (name, 3)
    assert not set(found) - {"event", "line", "n", "of"}


def test_only_a_name_that_needs_quotes_has_them() -> None:
    assert formatted("event=x line=%s", "shelter-a").endswith("event=x line=shelter-a")
    assert formatted("event=x line=%s", "shelter a").endswith('event=x line="shelter a"')
    assert formatted('event=x line="%s"', "shelter a").endswith('event=x line="shelter a"')
    assert formatted("event=x error=%s", '"no \\"port\\""').endswith('event=x error="no \\"port\\""'), (
        "it has them already"
    )
    assert formatted("event=line_up line=%s%s", "a", " down_s=1").endswith("line=a down_s=1"), "a piece of an event"


@given(st.text(max_size=200))
def test_json_is_one_line_whatever_is_in_it(text: str) -> None:
    assert as_json('event=x peer="%s" n=1', text)["event"] == "x"
    assert as_json("%s", f"!{text}")["event"] == "log"


def test_json_has_the_traceback_in_its_line() -> None:
    record = logging.LogRecord("g", logging.ERROR, "", 0, "event=task_failed", (), None)
    try:
        _ = 1 / int("0")
    except ZeroDivisionError:
        record.exc_info = sys.exc_info()
    (line,) = JsonFormatter().format(record).splitlines()
    assert "ZeroDivisionError" in json.loads(line)["traceback"]


def test_the_level_of_the_command_line_goes_before_the_files(root: logging.Logger) -> None:
    writer = LogWriter(os.open(os.devnull, os.O_WRONLY), journal=False)
    found = []
    for log, level, form in ((Log(writer, None), "warning", "json"), (Log(writer, Level.ERROR), "debug", "text")):
        log.use(level, form)
        found.append((root.level, type(writer.formatter)))
    assert found == [(logging.WARNING, JsonFormatter), (logging.ERROR, EventFormatter)]
    writer.close()


OURS = {
    ("core/line_news.py", "event=device_%s line=%s device=%s address=%d before=%s lasted_s=%.1f%s"),  # states
    ("faces/modbus/dispatch.py", "%s"),  # a line of core/policy.py: codes, addresses, and roles, which have no quotes
    ("faces/modbus/tls.py", "event=tls_refused peer=%s reason=%s left_out=%d%s"),  # DNS names and IP addresses alone
    ("faces/modbus/writer.py", "%s"),  # as of dispatch.py
    ("service/conditions.py", "event=condition unit_id=%d %s=%s"),  # a condition of a map
}
"""Messages with a text that is not quoted where it stands, because it is the gateway's own."""


def test_every_text_in_an_event_stands_where_it_is_quoted() -> None:
    """Who adds a message with a text at another place sees to it that it holds nothing of a peer."""
    package = Path(__file__).parents[2] / "gateway"
    loose = set()
    for path in package.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            match node:
                case ast.Call(ast.Attribute(ast.Name("log" | "_log" | "logger")), args):
                    texts = [arg.value for arg in args if isinstance(arg, ast.Constant) and isinstance(arg.value, str)]
                    for text in texts[:1]:
                        if re.search(r'(?<![="])%s', text):
                            loose.add((path.relative_to(package).as_posix(), text))
    assert loose == OURS
