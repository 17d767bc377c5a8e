"""`/api/v1/log`: what may be asked, what is answered, and what happens when reading fails or nobody takes it."""

from __future__ import annotations

import asyncio
import json
import socket
from collections.abc import AsyncGenerator, AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import replace
from pathlib import Path

import pytest
from aiohttp import ClientError, ClientSession

from gateway.core.daylog import CONTENT_TYPES, LogFormat, Selection, parse_moment
from gateway.core.site import Site
from gateway.core.stats import ModbusServerStats
from gateway.errors import HistoryError
from gateway.faces.http.api import MAX_EXPORTS, parse_query
from gateway.faces.http.app import HttpFace
from gateway.faces.http.settings import HttpSettings

from .conftest import ManualClock

URL = "/api/v1/log"


class Days:
    """A `DayLog` that gives pieces, or fails where it is told to."""

    def __init__(self) -> None:
        self.pieces: list[bytes | Exception | asyncio.Event] = [b"one ", b"two"]
        self.asked: list[tuple[LogFormat, Selection]] = []
        self.closed = 0

    async def devices(self) -> frozenset[str]:
        return frozenset({"gone-7"})

    async def export(self, form: LogFormat, selection: Selection) -> AsyncGenerator[bytes, None]:
        self.asked.append((form, selection))
        try:
            for piece in self.pieces:
                if isinstance(piece, Exception):
                    raise piece
                if isinstance(piece, asyncio.Event):
                    await piece.wait()
                else:
                    yield piece
        finally:
            self.closed += 1


@pytest.fixture
def days() -> Days:
    return Days()


@asynccontextmanager
async def serving(site: Site, clock: ManualClock, days: Days | None, **settings: object) -> AsyncIterator[str]:
    """A face with this history; gives the address of its log."""
    chosen = replace(HttpSettings(listen=(("127.0.0.1", 0),)), **settings)  # type: ignore[arg-type]  # replace checks
    face = HttpFace(chosen, site, clock, modbus=ModbusServerStats(), snmp=dict, not_ready=tuple, log=days)
    (listener,) = face.listeners
    await listener.start()
    assert listener.bound is not None
    try:
        yield f"http://127.0.0.1:{listener.bound[1]}{URL}"
    finally:
        await listener.stop()


@pytest.fixture
async def url(site: Site, clock: ManualClock, days: Days) -> AsyncIterator[str]:
    async with serving(site, clock, days) as address:
        yield address


async def get(url: str, query: str = "") -> tuple[int, str, str]:
    """Status, content type and text."""
    async with ClientSession() as session, session.get(url + query) as reply:
        return reply.status, reply.headers["Content-Type"], await reply.text()


@pytest.mark.parametrize("form", list(LogFormat))
async def test_the_days_come_in_the_form_that_was_asked_for(url: str, days: Days, form: LogFormat) -> None:
    assert await get(url, f"?format={form}") == (200, CONTENT_TYPES[form], "one two")
    assert days.asked == [(form, Selection())]
    assert days.closed == 1


async def test_device_and_dates_select(url: str, days: Days) -> None:
    query = "?device=array-2&since=2026-01-01&until=2026-01-31"
    assert (await get(url, query))[0] == 200
    selection = Selection("array-2", parse_moment("2026-01-01T00:00:00Z"), parse_moment("2026-02-01T00:00:00Z"))
    assert days.asked == [(LogFormat.JSON, selection)]


@pytest.mark.parametrize("name", ["array-1", "gone-7"])
async def test_a_device_of_now_or_then_is_known(url: str, name: str) -> None:
    assert (await get(url, f"?device={name}"))[0] == 200


@pytest.mark.parametrize(
    ("query", "status", "words"),
    [
        ("?device=nobody", 404, "no device is called 'nobody'"),
        ("?format=xml", 400, "allowed: csv, json, jsonl, openmetrics"),
        ("?form=csv", 400, "unknown parameter 'form'; allowed: device, since, until, format"),
        ("?since=yesterday", 400, "'yesterday' is no date; allowed: a date such as 2026-11-22"),
        ("?until=2026-13-01", 400, "no date"),
        ("?since=99999-01-01", 400, "no date"),
    ],
)
async def test_what_is_wrong_is_said_with_what_is_allowed(
    url: str, days: Days, query: str, status: int, words: str
) -> None:
    found, content_type, text = await get(url, query)
    assert (found, content_type) == (status, "application/json; charset=utf-8")
    assert words in json.loads(text)["error"]
    assert days.asked == []


async def test_where_no_history_is_kept_it_says_so(site: Site, clock: ManualClock) -> None:
    async with serving(site, clock, None) as url:
        status, _, text = await get(url)
    assert (status, json.loads(text)["error"]) == (404, "no history is kept: history.enabled is false")


async def test_a_history_that_cannot_be_read_is_503(url: str, days: Days) -> None:
    days.pieces = [HistoryError("corrupt", "/x/history.sqlite3: malformed")]
    status, _, text = await get(url)
    assert (status, json.loads(text)["error"]) == (503, "/x/history.sqlite3: malformed")
    assert (await get(url))[0] == 503  # and the place is free again


async def test_a_part_is_never_taken_for_the_whole(url: str, days: Days) -> None:
    days.pieces = [b"one", HistoryError("corrupt", "malformed")]
    with pytest.raises(ClientError):
        await get(url)
    assert days.closed == 1


async def test_no_more_than_two_exports_at_a_time(url: str, days: Days) -> None:
    gate = asyncio.Event()
    days.pieces = [b"one", gate, b"two"]
    running = [asyncio.create_task(get(url)) for _ in range(MAX_EXPORTS)]
    async with asyncio.timeout(30):
        while len(days.asked) < MAX_EXPORTS:  # noqa: ASYNC110  # the stub has no event
            await asyncio.sleep(0.005)
    status, _, text = await get(url)
    assert (status, "2 exports" in text) == (503, True)
    gate.set()
    assert [reply[2] for reply in await asyncio.gather(*running)] == ["onetwo"] * MAX_EXPORTS
    assert (await get(url))[0] == 200


async def test_a_reader_that_takes_nothing_is_given_up(site: Site, clock: ManualClock, days: Days) -> None:
    days.pieces = [bytes(1 << 20)] * 64
    async with serving(site, clock, days, send_timeout_s=0.2) as url:
        port = int(url.split(":")[2].split("/")[0])
        with socket.create_connection(("127.0.0.1", port)) as deaf:
            deaf.sendall(f"GET {URL} HTTP/1.1\r\nHost: x\r\n\r\n".encode())
            async with asyncio.timeout(30):
                while not days.closed:  # noqa: ASYNC110  # the stub has no event
                    await asyncio.sleep(0.005)
        assert (await get(url, "?device=nobody"))[0] == 404


async def test_it_is_guarded_like_everything_else(site: Site, clock: ManualClock, days: Days, tmp_path: Path) -> None:
    token = tmp_path / "token"
    token.write_text("a-token-that-is-long-enough\n")
    token.chmod(0o600)
    async with serving(site, clock, days, bearer_token_file=str(token)) as url, ClientSession() as session:
        assert (await get(url))[0] == 401
        async with session.get(url, headers={"Authorization": "Bearer a-token-that-is-long-enough"}) as reply:
            assert reply.status == 200
    assert len(days.asked) == 1


async def test_head_says_what_it_would_be(url: str) -> None:
    async with ClientSession() as session, session.head(url, params={"format": "csv"}) as reply:
        assert (reply.status, reply.headers["Content-Type"]) == (200, CONTENT_TYPES[LogFormat.CSV])


@pytest.mark.parametrize(
    ("text", "end", "moment"),
    [
        ("2026-11-22", False, 1795305600.0),
        ("2026-11-22", True, 1795305600.0 + 86400),
        ("2026-11-22T18:30", True, 1795305600.0 + 66600),
        ("2026-11-22T18:30:00Z", False, 1795305600.0 + 66600),
        ("2026-11-22T18:30:00+01:00", False, 1795305600.0 + 63000),
        ("20261122", False, 1795305600.0),
    ],
)
def test_moments(text: str, end: bool, moment: float) -> None:
    assert parse_moment(text, end=end) == moment


@pytest.mark.parametrize("text", ["", "now", "2026", "2026-02-30", "9999-12-31", "1e9", "2026-11-22T25:00"])
def test_no_moments(text: str) -> None:
    with pytest.raises(ValueError, match="is no date"):
        parse_moment(text, end=True)


def test_everything_may_be_left_out() -> None:
    assert parse_query({}) == (LogFormat.JSON, Selection())
