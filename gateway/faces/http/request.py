"""A request as a handler sees it, and what a handler gives back.

A handler returns a `Reply`, or sends one itself, piece by piece, and returns None. It sees who asks and what for; the
connection that it came by is behind `Exchange`.
"""

from __future__ import annotations

import json
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

from gateway.faces.http.wire import Fields, Head

JSON = "application/json; charset=utf-8"
NO_STORE = (("Cache-Control", "no-store"),)


@dataclass(frozen=True, slots=True)
class Reply:
    """A whole reply."""

    status: int
    body: bytes
    content_type: str = "text/plain; charset=utf-8"
    fields: tuple[tuple[str, str], ...] = NO_STORE

    @classmethod
    def json(cls, document: object, status: int = 200, fields: tuple[tuple[str, str], ...] = NO_STORE) -> Reply:
        """A document as JSON."""
        return cls(status, json.dumps(document).encode(), JSON, fields)


class Exchange(Protocol):
    """The way back to who asked."""

    @property
    def local(self) -> tuple[str, int]:
        """The address that was connected to."""
        ...

    @property
    def peer(self) -> str:
        """Who asks: an address."""
        ...

    @property
    def secure(self) -> bool:
        """Whether by TLS."""
        ...

    def begin(self, fields: Fields) -> None:
        """Begin a reply of status 200 that comes in pieces."""
        ...

    async def write(self, data: bytes) -> None:
        """Send a piece; returns when there is room for another one."""
        ...

    async def end(self) -> None:
        """End the reply; returns when the system has taken most of it."""
        ...

    def abort(self) -> None:
        """End the connection at once, so that nobody takes a part for the whole."""
        ...


@dataclass(frozen=True, slots=True)
class Request:
    """What is asked, and the way back."""

    head: Head
    by: Exchange

    @property
    def path(self) -> str:
        """What is asked for."""
        return self.head.path

    @property
    def query(self) -> Mapping[str, str]:
        """Its parameters."""
        return self.head.query

    @property
    def head_only(self) -> bool:
        """Whether the reply is to have no body."""
        return self.head.method == "HEAD"

    def field(self, name: str) -> str:
        """A header field by its name in lower case; "" when there is none."""
        return self.head.fields.get(name, "")


Handler = Callable[[Request], Awaitable[Reply | None]]
