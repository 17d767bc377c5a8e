"""The recording of a line: what was sent and received, byte for byte, and when.

Rule 1: a recording is text, JSON on each line: first an object that says what was recorded, then for each piece
        `[seconds since the start, ">" sent or "<" received, bytes in hexadecimal]`, in the order of time; of a
        Modbus TCP upstream with the number of the connection after it, where that is not 0.
Rule 2: pieces are as the port gave them: a reply may come in several, and noise is in them. One without bytes means
        that whoever would have sent them closed the connection.
Rule 3: `Recording.parse` accepts what `header_line` and `Piece.line` write, or raises ValueError with the number of the
        line; nothing else.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

FORMAT = "prostar-gateway line recording 1"
SENT, RECEIVED = ">", "<"
LONGEST_PIECE = 16384
_CONNECTIONS = range(8)


@dataclass(frozen=True, slots=True)
class Piece:
    """Bytes in one direction; `at_s` is when, in seconds since the start of the recording."""

    at_s: float
    sent: bool
    data: bytes
    connection: int = 0

    def line(self) -> str:
        """The piece as a line of the file, without its end."""
        connection = f", {self.connection}" if self.connection else ""
        return f'[{self.at_s:.6f}, "{SENT if self.sent else RECEIVED}", "{self.data.hex()}"{connection}]'

    @classmethod
    def parse(cls, text: str) -> Piece:
        """The piece of a line; ValueError when it is none."""
        found = json.loads(text)
        match found:
            case [int() | float() as at_s, str() as direction, str() as data, *rest] if direction in {SENT, RECEIVED}:
                octets = bytes.fromhex(data)
            case _:
                raise ValueError("no piece of a recording")
        connection = rest[0] if len(rest) == 1 else 0 if not rest else None
        if isinstance(at_s, bool) or type(connection) is not int or connection not in _CONNECTIONS:
            raise ValueError("no piece of a recording")
        if not 0 <= at_s < 1e9 or len(octets) > LONGEST_PIECE:
            raise ValueError("no piece of a recording")
        return cls(float(at_s), direction == SENT, octets, connection)


@dataclass(frozen=True, slots=True)
class Recording:
    """A line as it was: `about` is what the first line says, the pieces are in the order of time."""

    about: Mapping[str, Any]
    pieces: tuple[Piece, ...]

    @classmethod
    def parse(cls, lines: Iterable[str]) -> Recording:
        """The recording in the lines of a file; ValueError names the first that is wrong."""
        about: Mapping[str, Any] | None = None
        pieces: list[Piece] = []
        for number, text in enumerate(lines, start=1):
            try:
                if about is None:
                    about = _about(text)
                elif text.strip():
                    pieces.append(Piece.parse(text))
            except (ValueError, RecursionError) as error:
                raise ValueError(f"line {number}: {error}") from None
            if len(pieces) > 1 and pieces[-1].at_s < pieces[-2].at_s:
                raise ValueError(f"line {number}: goes back in time")
        if about is None:
            raise ValueError("line 1: no recording")
        return cls(about, tuple(pieces))


def header_line(about: Mapping[str, Any]) -> str:
    """The first line of a recording, without its end."""
    return json.dumps({"format": FORMAT, **about})


def _about(text: str) -> Mapping[str, Any]:
    found = json.loads(text)
    if not isinstance(found, dict) or found.get("format") != FORMAT:
        raise ValueError(f'no recording; its first line says "format": "{FORMAT}"')
    return found
