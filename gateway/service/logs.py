"""The log: one line an event, `time=… level=… event=… key=value …`, to standard error.

Rule 1: an event is one line whatever a peer sent: line ends and other control characters are written escaped. Only a
traceback takes more lines.
Rule 2: a message of a library, which knows no events, becomes `event=log logger=… message="…"`.
Rule 3: a log that cannot be written never disturbs the gateway.
"""

from __future__ import annotations

import json
import logging
import re
import sys
import time
from enum import StrEnum
from typing import TextIO

_EVENT = re.compile(r"event=\S")
_BARE_EVENT = re.compile(r"[a-z][a-z0-9_]*(?= [a-z][a-z0-9_]*=|$)")
_CONTROL = re.compile(r"[\x00-\x1f\x7f\x80-\x9f\u2028\u2029]")


class Level(StrEnum):
    """From which level on events are written."""

    DEBUG = "debug"
    INFO = "info"
    WARNING = "warning"
    ERROR = "error"


class EventFormatter(logging.Formatter):
    """Formats a record by the rules of this file."""

    converter = staticmethod(time.gmtime)
    default_time_format = "%Y-%m-%dT%H:%M:%S"
    default_msec_format = "%s.%03dZ"

    def format(self, record: logging.LogRecord) -> str:
        """See the rules of this file."""
        message = _CONTROL.sub(_escape, record.getMessage())
        if _BARE_EVENT.match(message):
            message = f"event={message}"
        elif not _EVENT.match(message):
            message = f"event=log logger={record.name} message={json.dumps(message, ensure_ascii=False)}"
        line = f"time={self.formatTime(record)} level={record.levelname.lower()} {message}"
        if record.exc_info and record.exc_info[0] is not None:
            line = f"{line}\n{self.formatException(record.exc_info)}"
        return line


def set_up_logging(level: Level, stream: TextIO | None = None) -> None:
    """Write events of `level` and above to `stream` (standard error)."""
    logging.raiseExceptions = False  # rule 3: the reader of the log may be gone
    handler = logging.StreamHandler(stream if stream is not None else sys.stderr)
    handler.setFormatter(EventFormatter())
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(level.upper())
    for library in ("asyncio", "aiohttp", "pymodbus", "pysnmp"):
        logging.getLogger(library).setLevel(logging.DEBUG if level is Level.DEBUG else logging.WARNING)


def _escape(found: re.Match[str]) -> str:
    return found.group().encode("unicode_escape").decode()
