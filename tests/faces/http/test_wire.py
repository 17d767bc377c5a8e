"""Heads of requests: what is one, what never becomes one, and that both are seen at once."""

from __future__ import annotations

import email.utils

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.faces.http.wire import FIELDS, HEAD_BYTES, Head, Refusal, chunk, http_date, reply_head, take

GET = b"GET /metrics HTTP/1.1\r\nHost: gateway:9850\r\n"


def taken(data: bytes) -> tuple[Head | Refusal | None, bytes]:
    buffer = bytearray(data)
    return take(buffer), bytes(buffer)


def head(data: bytes) -> Head:
    found, _ = taken(data)
    assert isinstance(found, Head)
    return found


def test_a_request() -> None:
    found, rest = taken(b"\r\n" + GET + b"Accept: text/plain \r\nACCEPT:\tapplication/json\r\n\r\nGET /next")
    assert isinstance(found, Head)
    assert (found.method, found.path, dict(found.query), found.host) == ("GET", "/metrics", {}, "gateway:9850")
    assert found.fields["accept"] == "text/plain, application/json"
    assert (found.keep_alive, found.chunked, found.body) == (True, True, False)
    assert rest == b"GET /next"


@pytest.mark.parametrize(
    ("target", "path", "query", "host"),
    [
        (b"/api?a=1&b=%C3%A4+x&a=2&c=", "/api", {"a": "1", "b": "ä x", "c": ""}, "h"),
        (b"http://other:80/sd?x=y", "/sd", {"x": "y"}, "other:80"),
        (b"HTTPS://other", "/", {}, "other"),
        (b"http://other?x=y", "/", {"x": "y"}, "other"),
        (b"//metrics", "//metrics", {}, "h"),
    ],
)
def test_targets(target: bytes, path: str, query: dict[str, str], host: str) -> None:
    found = head(b"GET " + target + b" HTTP/1.1\r\nHost: h\r\n\r\n")
    assert (found.path, dict(found.query), found.host) == (path, query, host)


@pytest.mark.parametrize(
    ("data", "keep_alive", "chunked", "body"),
    [
        (b"GET / HTTP/1.1\r\nHost: h\r\nConnection: TE, Close\r\n\r\n", False, True, False),
        (b"GET / HTTP/1.0\r\n\r\n", False, False, False),
        (b"GET / HTTP/1.0\r\nConnection: keep-alive\r\n\r\n", False, False, False),
        (b"GET / HTTP/1.1\r\nHost: h\r\nContent-Length: 00\r\n\r\n", True, True, False),
        (b"POST / HTTP/1.1\r\nHost: h\r\nContent-Length: 5\r\n\r\n", False, True, True),
        (b"POST / HTTP/1.1\r\nHost: h\r\nTransfer-Encoding: chunked\r\n\r\n", False, True, True),
    ],
)
def test_how_the_connection_goes_on(data: bytes, keep_alive: bool, chunked: bool, body: bool) -> None:
    found = head(data)
    assert (found.keep_alive, found.chunked, found.body) == (keep_alive, chunked, body)


@pytest.mark.parametrize(
    ("data", "status"),
    [
        (b"\x16\x03\x01", 400),
        (b"GET / HTTP/1.1\nHost: h\n", 400),
        (b"GET / HTTP/1.1\rHost: h", 400),
        (b"GET\r\n", 400),
        (b"GET /\r\n\r\n", 400),
        (b"GET / HTTP/2.0\r\nHost: h\r\n\r\n", 505),
        (b"GET  / HTTP/1.1\r\n", 400),
        (b"GET / HTTP/1.1\r\n\r\n", 400),
        (b"GET metrics HTTP/1.1\r\nHost: h\r\n\r\n", 400),
        (b"OPTIONS * HTTP/1.1\r\nHost: h\r\n\r\n", 400),
        (GET + b"Host: other\r\n\r\n", 400),
        (GET + b" folded\r\n\r\n", 400),
        (GET + b"Space : x\r\n\r\n", 400),
        (GET + b"Nul: \0\r\n\r\n", 400),
        (GET + b"no field\r\n\r\n", 400),
        (GET + b"Content-Length: 1\r\nContent-Length: 1\r\n\r\n", 400),
        (GET + b"Content-Length: -1\r\n\r\n", 400),
        (GET + b"Content-Length: +0\r\n\r\n", 400),
        (GET + b"Content-Length: \xb2\r\n\r\n", 400),
        (GET + b"A: b\r\n" * FIELDS + b"\r\n", 431),
        (GET + b"A: " + b"b" * HEAD_BYTES, 431),
        (b"GET /" + b"a" * HEAD_BYTES, 414),
        (b"GET /?" + b"a=b&" * 100 + b" HTTP/1.1\r\nHost: h\r\n\r\n", 400),
    ],
)
def test_what_never_becomes_a_request(data: bytes, status: int) -> None:
    found, _ = taken(data)
    assert isinstance(found, Refusal)
    assert found.status == status


@pytest.mark.parametrize("size", range(len(GET + b"\r\n")))
def test_a_part_is_waited_for(size: int) -> None:
    assert taken((GET + b"\r\n")[:size])[0] is None


@given(st.binary(max_size=300) | st.binary(max_size=60).map(lambda tail: GET + tail + b"\r\n\r\n"))
def test_any_bytes_are_a_request_a_refusal_or_a_part(data: bytes) -> None:
    found, rest = taken(data)
    assert data.endswith(rest)
    if isinstance(found, Head):
        assert len(rest) < len(data)
        assert found.path.startswith("/")
        assert not set("\r\n\0") & set("".join(found.fields.values()))


@given(st.integers(0, 2), st.lists(st.binary(min_size=1, max_size=20)), st.data())
def test_pieces_make_no_difference(empty: int, extra: list[bytes], draw: st.DataObject) -> None:
    fields = b"".join(b"X-%d: %s\r\n" % (number, text) for number, text in enumerate(extra))
    data = b"\r\n" * empty + GET + fields + b"\r\n"
    whole = take(bytearray(data))
    buffer = bytearray()
    cut = draw.draw(st.integers(0, len(data)))
    buffer += data[:cut]
    first = take(buffer)
    if first is None:
        buffer += data[cut:]
        first = take(buffer)
    assert isinstance(first, Refusal) if isinstance(whole, Refusal) else first == whole


def test_a_long_run_of_blanks_costs_no_time() -> None:
    found, _ = taken(GET + b"A:" + b" " * (HEAD_BYTES - 100) + b"\0\r\n\r\n")  # a test that hangs fails
    assert isinstance(found, Refusal)


def test_the_head_of_a_reply() -> None:
    fields = (("Content-Length", "2"), ("X-Ä", "é"))
    assert reply_head(200, fields, 1_700_000_000.0, keep_alive=True) == (
        "HTTP/1.1 200 OK\r\nDate: Tue, 14 Nov 2023 22:13:20 GMT\r\nContent-Length: 2\r\nX-Ä: é\r\n\r\n".encode(
            "latin-1"
        )
    )
    assert b"\r\nConnection: close\r\n\r\n" in reply_head(503, (), 0.0, keep_alive=False)


@given(st.integers(0, 4_000_000_000))
def test_dates_are_those_of_the_standard_library(wall: int) -> None:
    assert http_date(wall) == email.utils.formatdate(wall, usegmt=True)


def test_a_chunk() -> None:
    assert chunk(b"x" * 26) == b"1a\r\n" + b"x" * 26 + b"\r\n"
