"""The log: one line an event, `time=… level=… event=… key=value …` or the same as a JSON object, to standard error.

Rule 1: an event is one line whatever a peer sent: line ends and other control characters are written escaped. Only a
traceback takes more lines, and in JSON not even that.
Rule 2: a message of a library, which knows no events, becomes `event=log logger=… message="…"`.
Rule 3: a log that cannot be written never disturbs the gateway (log_writer.py).
Rule 4: a value ends where it ends: one with blanks or quotes in it, such as the name of a line, is quoted as in JSON.
"""

from __future__ import annotations

import json
import logging
import re
import time
from collections.abc import Mapping
from enum import StrEnum

from gateway.service.log_writer import LogWriter

_EVENT = re.compile(r"event=\S")
_BARE_EVENT = re.compile(r"[a-z][a-z0-9_]*(?= [a-z][a-z0-9_]*=|$)")
_PAIR = re.compile(r'([A-Za-z_][A-Za-z0-9_.]*)=("(?:[^"\\]|\\.)*"(?= |$)|"[^"]*"|[^ ]*)')
_QUOTED = re.compile(r'"(?:[^"\\]|\\.)*"')
_NEEDS_QUOTES = re.compile(r'[\s"]')
_NEEDS_ESCAPES = re.compile(r'["\\]')
_NUMBER = re.compile(r"-?(0|[1-9][0-9]{0,17})(\.[0-9]{1,17})?")
_PLACE = re.compile(r'%%|(?<==)%s(?= |$)|(?<==")%s(?="( |$))|%[^%a-zA-Z]*[a-zA-Z]')
_CONTROL = re.compile(r"[\x00-\x1f\x7f\x80-\x9f\u2028\u2029]")


class Level(StrEnum):
    """From which level on events are written."""

    DEBUG = "debug"
    INFO = "info"
    WARNING = "warning"
    ERROR = "error"


class Form(StrEnum):
    """How an event is written."""

    TEXT = "text"
    JSON = "json"


class EventFormatter(logging.Formatter):
    """Formats a record as text by the rules of this file."""

    converter = staticmethod(time.gmtime)
    default_time_format = "%Y-%m-%dT%H:%M:%S"
    default_msec_format = "%s.%03dZ"

    def format(self, record: logging.LogRecord) -> str:
        """See the rules of this file."""
        line = f"time={self.formatTime(record)} level={record.levelname.lower()} {event_of(record)}"
        if record.exc_info and record.exc_info[0] is not None:
            line = f"{line}\n{self.formatException(record.exc_info)}"
        return line


class JsonFormatter(EventFormatter):
    """Formats a record as one JSON object: time, level, event and its keys in their order, numbers as numbers."""

    def format(self, record: logging.LogRecord) -> str:
        """See the rules of this file."""
        found: dict[str, object] = {"time": self.formatTime(record), "level": record.levelname.lower()}
        for key, value in _PAIR.findall(event_of(record)):
            found[key] = _value(value)
        if record.exc_info and record.exc_info[0] is not None:
            found["traceback"] = self.formatException(record.exc_info)
        return json.dumps(found, ensure_ascii=False)


FORMATTERS: Mapping[Form, type[EventFormatter]] = {Form.TEXT: EventFormatter, Form.JSON: JsonFormatter}


def event_of(record: logging.LogRecord) -> str:
    """The message as an event (rules 1, 2 and 4)."""
    message = _CONTROL.sub(_escape, _message(record))
    if _BARE_EVENT.match(message):
        return f"event={message}"
    if not _EVENT.match(message):
        return f"event=log logger={record.name} message={json.dumps(message, ensure_ascii=False)}"
    return message


def set_up_logging(level: Level, form: Form, handler: logging.Handler) -> None:
    """Write events of `level` and above in this form; may be called again."""
    logging.raiseExceptions = False  # rule 3: the reader of the log may be gone
    handler.setFormatter(FORMATTERS[form]())
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(level.upper())
    for library in ("asyncio", "pysnmp"):
        logging.getLogger(library).setLevel(logging.DEBUG if level is Level.DEBUG else logging.WARNING)


class Log:
    """The log of a process: `use` the configuration's `[log]`; a level of the command line goes before its level."""

    def __init__(self, writer: LogWriter, level: Level | None) -> None:
        self.stats = writer.stats
        self._writer = writer
        self._level = level

    def use(self, level: str, form: str) -> None:
        """Log like this from now on."""
        set_up_logging(self._level or Level(level), Form(form), self._writer)


def _message(record: logging.LogRecord) -> str:
    """The message with its values in it (rule 4)."""
    if not isinstance(record.args, tuple) or not record.args or not isinstance(record.msg, str):
        return record.getMessage()
    places = [place for place in _PLACE.finditer(record.msg) if place.group() != "%%"]
    if len(places) != len(record.args):
        return record.getMessage()
    values = tuple(_quoted(value, place) for value, place in zip(record.args, places, strict=True))
    return record.msg % values


def _quoted(value: object, place: re.Match[str]) -> object:
    """A value as it can stand in its place: behind `key=`, within the quotes of `key="…"`, or anywhere else."""
    if not isinstance(value, str) or place.group() != "%s" or place.start() == 0:
        return value
    before = place.string[place.start() - 1]
    if before == "=" and _NEEDS_QUOTES.search(value) and not _QUOTED.fullmatch(value):
        return json.dumps(value, ensure_ascii=False)
    if before == '"' and _NEEDS_ESCAPES.search(value):
        return json.dumps(value, ensure_ascii=False)[1:-1]
    return value


def _value(text: str) -> object:
    """A value of `key=value`: a number, a quoted text, or a text."""
    if text.startswith('"'):
        try:
            return json.loads(text)
        except ValueError:
            return text[1:-1] if len(text) > 1 and text.endswith('"') else text[1:]
    if _NUMBER.fullmatch(text):
        return float(text) if "." in text else int(text)
    return text


def _escape(found: re.Match[str]) -> str:
    return found.group().encode("unicode_escape").decode()
