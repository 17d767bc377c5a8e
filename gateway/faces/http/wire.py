"""HTTP/1.1 heads, sans-IO (RFC 9110, RFC 9112): what a client asks, and what stands above a reply.

Rule 1: a request has no body here. One that announces a body is answered, and its connection closed, so that nothing
        is ever read as a request that was sent as something else.
Rule 2: lines end in CR LF and nothing else; no field is folded, none is there twice of which there can be one only.
Rule 3: a head is at most `HEAD_BYTES` long and has at most `FIELDS` fields. What cannot become a request is refused
        when it is looked at, not only when its end has come.
"""

from __future__ import annotations

import re
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from http import HTTPStatus
from types import MappingProxyType
from urllib.parse import parse_qsl

from gateway.errors import GatewayError

HEAD_BYTES = 16 * 1024
FIELDS = 100
PARAMETERS = 16

Fields = Iterable[tuple[str, str]]
"""Header fields of a reply; names and values are ours, without CR and LF."""

_END = b"\r\n\r\n"
_EMPTY_LINES = re.compile(rb"(?:\r\n)+")
_TOKEN = rb"[!#$%&'*+.^_`|~0-9A-Za-z-]+"
_METHOD_BEGINS = re.compile(rb"[!#$%&'*+.^_`|~0-9A-Za-z-]")
_REQUEST_LINE = re.compile(rb"(" + _TOKEN + rb") ([\x21-\x7e]+) HTTP/([0-9])\.([0-9])")
_FIELD = re.compile(rb"(" + _TOKEN + rb"):([\t\x20-\x7e\x80-\xff]*)")
_BARE = re.compile(rb"\r(?!\n|\Z)|(?<!\r)\n")
_ABSOLUTE = re.compile(r"https?://([^/?#]*)([^#]*)", re.IGNORECASE)
_ONCE = frozenset({"host", "content-length", "transfer-encoding", "authorization"})
_DAYS = ("Mon", "Tue", "Wed", "Thu", "Fri", "Sat", "Sun")
_MONTHS = ("Jan", "Feb", "Mar", "Apr", "May", "Jun", "Jul", "Aug", "Sep", "Oct", "Nov", "Dec")


@dataclass(frozen=True, slots=True)
class Head:
    """What a client asks."""

    method: str
    path: str  # as it was sent: no character of ours needs to be escaped
    query: Mapping[str, str]  # of a parameter that comes again, the first
    fields: Mapping[str, str]  # by name in lower case; lists in one, separated by commas
    host: str
    keep_alive: bool
    chunked: bool  # the client understands a reply in chunks
    body: bool  # it announces one (rule 1)


@dataclass(frozen=True, slots=True)
class Refusal:
    """What came is no request; the connection cannot be used any more."""

    status: int
    text: str


class _NoRequestError(GatewayError):
    """What came cannot become a request."""

    def __init__(self, status: int, text: str) -> None:
        super().__init__(text)
        self.refusal = Refusal(status, text)


def take(buffer: bytearray) -> Head | Refusal | None:
    """The next request, taken from the front of the buffer; None as long as its end has not come."""
    empty = _EMPTY_LINES.match(buffer)  # RFC 9112 §2.2
    if empty is not None:
        del buffer[: empty.end()]
    if not buffer or buffer == b"\r":
        return None
    try:
        return _take(buffer)
    except _NoRequestError as error:
        return error.refusal


def ends(buffer: bytearray, new: int) -> bool:
    """Whether a head ends in the last `new` bytes of the buffer."""
    return buffer.find(_END, max(0, len(buffer) - new - len(_END) + 1)) >= 0


def _take(buffer: bytearray) -> Head | None:
    end = buffer.find(_END, 0, HEAD_BYTES)
    head = bytes(buffer[: end if end >= 0 else HEAD_BYTES])
    if not _METHOD_BEGINS.match(head) or _BARE.search(head):
        raise _NoRequestError(400, "this is no HTTP")
    first, *lines = head.split(b"\r\n")
    request = _REQUEST_LINE.fullmatch(first)
    if end < 0:
        if request is None and lines:
            raise _NoRequestError(400, "no request line of HTTP/1.1")
        if len(buffer) < HEAD_BYTES:
            return None
        raise _NoRequestError(431 if lines else 414, f"a request's head has at most {HEAD_BYTES} bytes")
    if request is None:
        raise _NoRequestError(400, "no request line of HTTP/1.1")
    del buffer[: end + len(_END)]
    method, target, major, minor = request.groups()
    if major != b"1":
        raise _NoRequestError(505, "this is HTTP/1.1")
    fields = _fields(lines)
    if "host" not in fields and minor != b"0":
        raise _NoRequestError(400, "no host")
    host, path, query = _split(target.decode(), fields.get("host", ""))
    body = _has_body(fields)
    options = {option.strip().lower() for option in fields.get("connection", "").split(",")}
    return Head(
        method=method.decode(),
        path=path,
        query=MappingProxyType(query),
        fields=MappingProxyType(fields),
        host=host,
        keep_alive=minor != b"0" and "close" not in options and not body,
        chunked=minor != b"0",
        body=body,
    )


def _fields(lines: list[bytes]) -> dict[str, str]:
    if len(lines) > FIELDS:
        raise _NoRequestError(431, f"a request has at most {FIELDS} header fields")
    fields: dict[str, str] = {}
    for line in lines:
        found = _FIELD.fullmatch(line)
        if found is None:
            raise _NoRequestError(400, "no header field")
        name, value = found[1].decode().lower(), found[2].strip(b" \t").decode("latin-1")
        if name in fields and name in _ONCE:
            raise _NoRequestError(400, f"{name} is there twice")
        fields[name] = f"{fields[name]}, {value}" if name in fields else value
    return fields


def _split(target: str, host: str) -> tuple[str, str, dict[str, str]]:
    """Host, path and parameters of a request target, which may hold the host itself (RFC 9112 §3.2.2)."""
    if absolute := _ABSOLUTE.fullmatch(target):
        host, target = absolute[1], absolute[2] if absolute[2].startswith("/") else f"/{absolute[2]}"
    path, _, query = target.partition("?")
    if not path.startswith("/"):
        raise _NoRequestError(400, "no path")
    parameters: dict[str, str] = {}
    try:
        for name, value in parse_qsl(query, keep_blank_values=True, max_num_fields=PARAMETERS):
            parameters.setdefault(name, value)
    except ValueError:
        raise _NoRequestError(400, f"a request has at most {PARAMETERS} parameters") from None
    return host, path, parameters


def _has_body(fields: Mapping[str, str]) -> bool:
    length = fields.get("content-length", "0")
    if not (length.isascii() and length.isdigit()):
        raise _NoRequestError(400, "no content-length")
    return "transfer-encoding" in fields or bool(length.strip("0"))


def reply_head(status: int, fields: Fields, wall: float, *, keep_alive: bool) -> bytes:
    """What stands above a reply's body; `wall` is the time now."""
    lines = [f"HTTP/1.1 {status} {HTTPStatus(status).phrase}", f"Date: {http_date(wall)}"]
    lines += [f"{name}: {value}" for name, value in fields]
    if not keep_alive:
        lines.append("Connection: close")
    return "\r\n".join((*lines, "", "")).encode("latin-1")


def http_date(wall: float) -> str:
    """A time as RFC 9110 §5.6.7 writes it, whatever language this machine speaks."""
    at = time.gmtime(wall)
    date = f"{_DAYS[at.tm_wday]}, {at.tm_mday:02d} {_MONTHS[at.tm_mon - 1]} {at.tm_year:04d}"
    return f"{date} {at.tm_hour:02d}:{at.tm_min:02d}:{at.tm_sec:02d} GMT"


def chunk(data: bytes) -> bytes:
    """A chunk of a body (RFC 9112 §7.1)."""
    return b"%x\r\n%b\r\n" % (len(data), data)


LAST_CHUNK = b"0\r\n\r\n"
