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


class Packer(Protocol):
    """One stream."""

    def compress(self, data: memoryview) -> bytes:
        """What there is to send after more input; often nothing."""
        ...

    def flush(self) -> bytes:
        """The end of the stream."""
        ...


def packer() -> Packer:
    """A new stream."""
    try:
        library = importlib.import_module("isal.isal_zlib")
    except ImportError:
        return zlib.compressobj(_LEVEL, zlib.DEFLATED, _GZIP_WINDOW)
    found: Packer = library.compressobj(_LEVEL, zlib.DEFLATED, _GZIP_WINDOW)
    return found
