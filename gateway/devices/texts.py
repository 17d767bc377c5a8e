"""Text codecs: how the bytes of several words become a text and back.

Rule 1: words are taken in the order of their addresses; the reading's order says which byte of each comes first
        ("hi-lo": the high one, "lo-hi": the low one, as where a device swaps the characters of a word).
Rule 2: "no value" is `None`: nothing written there, or bytes that are no such text. Never a substitute.
Rule 3: encode refuses with ValueError what it cannot say; decoding what it gave yields the same text.
"""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

from gateway.devices.model import WordOrder

MAX_WORDS = 8

_MAC = re.compile(r"[0-9a-f]{2}(:[0-9a-f]{2}){5}")
_VERSION = re.compile(r"(\d{1,3})\.(\d{1,3})")


@dataclass(frozen=True, slots=True)
class TextCodec:
    """One way to read bytes as text: `decode(data)` or None, `encode(text, size)` or ValueError."""

    name: str
    words: frozenset[int]  # how many words a point may have
    text: str  # for people
    decode: Callable[[bytes], str | None]
    encode: Callable[[str, int], bytes]


def ascii_text(data: bytes) -> str | None:
    """Characters up to the first NUL without what pads them; None when empty or not printable ASCII."""
    text = data.partition(b"\0")[0].strip(b" \xff").decode("latin-1")
    return text if text and text.isascii() and text.isprintable() else None


def _ascii_encode(text: str, size: int) -> bytes:
    if ascii_text(text.encode("latin-1", "replace")) != text or len(text) > size:
        raise ValueError(f"{text!r} is not 1 to {size} printable ASCII characters, a blank neither first nor last")
    return text.encode("ascii").ljust(size, b"\0")


def _ipv4_decode(data: bytes) -> str:
    return str(ipaddress.IPv4Address(data))


def _ipv4_encode(text: str, _size: int) -> bytes:
    return ipaddress.IPv4Address(text).packed


def _mac_decode(data: bytes) -> str | None:
    return None if data in {bytes(6), b"\xff" * 6} else data.hex(":")


def _mac_encode(text: str, _size: int) -> bytes:
    data = bytes.fromhex(text.replace(":", "")) if _MAC.fullmatch(text) else b""
    if _mac_decode(data or bytes(6)) is None:
        raise ValueError(f"{text!r} is no MAC address like 00:1e:c0:01:02:03")
    return data


def _version_decode(data: bytes) -> str | None:
    return None if data == b"\xff\xff" else f"{data[0]}.{data[1]}"


def _version_encode(text: str, _size: int) -> bytes:
    found = _VERSION.fullmatch(text)
    parts = [int(part) for part in found.groups()] if found else [256]
    if max(parts) > 255 or parts == [255, 255]:
        raise ValueError(f"{text!r} is no version like 1.2")
    return bytes(parts)


TEXT_CODECS: Mapping[str, TextCodec] = MappingProxyType(
    {
        codec.name: codec
        for codec in (
            TextCodec("ascii", frozenset(range(1, MAX_WORDS + 1)), "ASCII text", ascii_text, _ascii_encode),
            TextCodec("ipv4", frozenset({2}), "IPv4 address", _ipv4_decode, _ipv4_encode),
            TextCodec("mac", frozenset({3}), "MAC address", _mac_decode, _mac_encode),
            TextCodec("version", frozenset({1}), "version of a byte and a byte", _version_decode, _version_encode),
        )
    }
)


def swapped(data: bytes, order: WordOrder) -> bytes:
    """Bytes of big-endian words in the order of the text, and back: it is its own inverse."""
    if order is WordOrder.HI_LO:
        return data
    return b"".join(data[at : at + 2][::-1] for at in range(0, len(data), 2))


def decode_text(codec: str, data: bytes, order: WordOrder) -> str | None:
    """Decode big-endian words as they came from the wire; None for "no value"."""
    return TEXT_CODECS[codec].decode(swapped(data, order))


def encode_text(codec: str, text: str, n_words: int, order: WordOrder) -> tuple[int, ...]:
    """Encode a text to words in address order; ValueError if it cannot be."""
    return words_of(swapped(TEXT_CODECS[codec].encode(text, 2 * n_words), order))


def words_of(data: Sequence[int]) -> tuple[int, ...]:
    """Big-endian bytes as words."""
    return tuple(data[at] << 8 | data[at + 1] for at in range(0, len(data), 2))
