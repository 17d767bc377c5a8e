"""Text that came from elsewhere, such as a socket or somebody's file, as it can be shown."""

from __future__ import annotations


def printable(text: str) -> str:
    """The text with `?` for whatever is not seen on a terminal but does something to it."""
    return "".join(letter if letter.isprintable() else "?" for letter in text)
