"""`/api/v1/log`: the stored days of the controllers, for programs.

    GET /api/v1/log?device=array-1&since=2026-01-01&until=2026-01-31&format=csv

Everything may be left out: all devices, all days, JSON. Dates are those of core/daylog.py. What is wrong with a request
is said as `{"error": …}`: 400 for a parameter, 404 for a device nobody knows or where no history is kept, 503 while it
cannot be read or `MAX_EXPORTS` others are being sent. The reply comes in pieces as it is read; a reader that takes no
piece for the face's `send_timeout_s` is given up. When reading fails on the way the connection is broken off, so
that no reader takes a part for the whole.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator, Mapping
from contextlib import aclosing

from gateway.core.daylog import CONTENT_TYPES, DayLog, LogFormat, Selection, parse_moment
from gateway.core.site import Site
from gateway.errors import HistoryError
from gateway.faces.http.request import Reply, Request

PATH = "/api/v1/log"
MAX_EXPORTS = 2
RETRY_AFTER = ("Retry-After", "10")

_PARAMETERS = ("device", "since", "until", "format")
_FIELDS = (("Cache-Control", "no-store"), ("X-Content-Type-Options", "nosniff"))
_log = logging.getLogger(__name__)


class LogApi:
    """Answers requests for the log; `log` is None where no history is kept."""

    def __init__(self, site: Site, log: DayLog | None, send_timeout_s: float) -> None:
        self.adjust(site, log)
        self._send_timeout_s = send_timeout_s
        self._exports = 0

    def adjust(self, site: Site, log: DayLog | None) -> None:
        """Answer about another site, or from another log; exports that are being sent go on."""
        self._devices = frozenset(device.name for device in site.devices)
        self._log = log

    async def handle(self, request: Request) -> Reply | None:
        """The days asked for."""
        if self._log is None:
            return _error(404, "no history is kept: history.enabled is false")
        try:
            form, selection = parse_query(request.query)
        except ValueError as error:
            return _error(400, str(error))
        if self._exports >= MAX_EXPORTS:
            return _error(503, f"{MAX_EXPORTS} exports are being sent already", RETRY_AFTER)
        self._exports += 1
        try:
            if selection.device is not None and selection.device not in self._devices | await self._log.devices():
                return _error(404, f"no device is called {selection.device!r}")
            async with aclosing(self._log.export(form, selection)) as pieces:
                first = await anext(pieces, b"")  # errors before the header are an answer
                await self._send(request, form, first, pieces)
                return None
        except HistoryError as error:
            return _error(503, str(error), RETRY_AFTER)
        finally:
            self._exports -= 1

    async def _send(self, request: Request, form: LogFormat, first: bytes, pieces: AsyncIterator[bytes]) -> None:
        by = request.by
        by.begin((*_FIELDS, ("Content-Type", CONTENT_TYPES[form])))
        if request.head_only:
            return
        try:
            async with asyncio.timeout(self._send_timeout_s):
                await by.write(first)
            async for piece in pieces:
                async with asyncio.timeout(self._send_timeout_s):
                    await by.write(piece)
            async with asyncio.timeout(self._send_timeout_s):
                await by.end()
        except (TimeoutError, HistoryError) as error:
            _log.warning('event=log_export_broken_off peer="%s" reason="%s"', by.peer, str(error) or "not taken")
            by.abort()


def parse_query(query: Mapping[str, str]) -> tuple[LogFormat, Selection]:
    """Form and selection; ValueError says what is wrong and what is allowed."""
    unknown = [name for name in query if name not in _PARAMETERS]
    if unknown:
        raise ValueError(f"unknown parameter {unknown[0]!r}; allowed: {', '.join(_PARAMETERS)}")
    form = query.get("format", LogFormat.JSON.value)
    if form not in {known.value for known in LogFormat}:
        raise ValueError(f"format={form!r}; allowed: {', '.join(known.value for known in LogFormat)}")
    since = query.get("since")
    until = query.get("until")
    return LogFormat(form), Selection(
        query.get("device"),
        None if since is None else parse_moment(since),
        None if until is None else parse_moment(until, end=True),
    )


def _error(status: int, text: str, *fields: tuple[str, str]) -> Reply:
    return Reply.json({"error": text}, status, (*_FIELDS, *fields))
