"""The form of a recording: what is written is read again, and anything else is one documented error."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.modbus.recording import FORMAT, Piece, Recording, header_line

HEADER = header_line({"line": "shelter-a", "baudrate": 9600})
PIECES = st.lists(
    st.builds(
        Piece,
        st.integers(0, 10**12).map(lambda micros: micros / 1e6),
        st.booleans(),
        st.binary(max_size=300),
        st.integers(0, 7),
    )
)


@given(PIECES)
def test_what_is_written_is_read_again(pieces: list[Piece]) -> None:
    ordered = tuple(sorted(pieces, key=lambda piece: piece.at_s))
    found = Recording.parse([HEADER, *(piece.line() for piece in ordered)])
    assert found.pieces == ordered
    assert found.about["line"] == "shelter-a"


@given(st.lists(st.text(max_size=60)), st.booleans())
def test_anything_else_is_a_value_error(lines: list[str], header: bool) -> None:
    try:
        found = Recording.parse([HEADER, *lines] if header else lines)
    except ValueError as error:
        named = str(error)
    else:
        named = "line " if header and len(found.pieces) <= len(lines) else "accepted"
    assert named.startswith("line ")


@pytest.mark.parametrize(
    ("line", "number"),
    [
        ('[1.0, ">"]', 2),
        ('[-1.0, ">", "00"]', 2),
        ('[true, ">", "00"]', 2),
        ('[NaN, ">", "00"]', 2),
        ('[1.0, "=", "00"]', 2),
        ('[1.0, ">", "0"]', 2),
        ('[1.0, ">", "00", 8]', 2),
        ('[1.0, ">", "00", true]', 2),
        ('[1.0, ">", "00", 1, 1]', 2),
        ("[" * 5000, 2),
        ('[2.0, ">", "00"]\n[1.0, ">", "00"]', 3),
    ],
)
def test_the_first_wrong_line_is_named(line: str, number: int) -> None:
    with pytest.raises(ValueError, match=f"^line {number}: "):
        Recording.parse([HEADER, *line.split("\n")])


@pytest.mark.parametrize("first", ["", "{}", "[]", '{"format": "other"}', FORMAT])
def test_another_file_is_no_recording(first: str) -> None:
    with pytest.raises(ValueError, match=r"^line 1: "):
        Recording.parse([first])


def test_an_empty_file_is_no_recording() -> None:
    with pytest.raises(ValueError, match=r"^line 1: no recording"):
        Recording.parse([])
