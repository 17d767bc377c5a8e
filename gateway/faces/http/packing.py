"""What compresses a scrape: ISA-L where it is installed (the extra `fast`), in an eighth of zlib's time; else zlib.

Both write one gzip stream (RFC 1952), piece by piece, at the lowest level: a tenth of the size or less already; higher
levels cost the loop more time than they save.
"""

from __future__ import annotations

import importlib
import zlib
from typing import Protocol

_LEVEL = 1
_GZIP_WINDOW = 31  # both libraries' way to ask for a gzip header
_ISAL_STEP = 64 * 1024
_ZLIB_STEP = 16 * 1024
"""Bytes that take about a tenth of a millisecond."""


class Packer(Protocol):
    """One stream."""

    def compress(self, data: memoryview) -> bytes:
        """What there is to send after more input; often nothing."""
        ...

    def flush(self) -> bytes:
        """The end of the stream."""
        ...


def packer() -> tuple[Packer, int]:
    """A new stream, and how many bytes it should be given at a time."""
    try:
        library = importlib.import_module("isal.isal_zlib")
    except ImportError:
        return zlib.compressobj(_LEVEL, zlib.DEFLATED, _GZIP_WINDOW), _ZLIB_STEP
    found: Packer = library.compressobj(_LEVEL, zlib.DEFLATED, _GZIP_WINDOW)
    return found, _ISAL_STEP
