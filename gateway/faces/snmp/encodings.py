"""The numbers of points in the MIB, and as they stand on the wire.

A controller measures in half-precision floats and small words, so all cells together show few different numbers: in a
second of 200 controllers some thousand at most. Rules:

1. What a number looks like depends on it and on syntax and scale alone, so it is found by these, for all columns that
   have the same. Equal numbers look the same, whether they are int or float.
2. A number that has no value in the MIB (not finite, out of range) is not there: KeyError.
3. No more than MOST_KEPT are kept for a syntax and scale; then all are forgotten and made again as they come.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache

from gateway.devices.model import Value
from gateway.faces.snmp import wire
from gateway.faces.snmp.objects import CellValue, Syntax, in_range

MOST_KEPT = 2048
"""About 150 octets each."""


class Encodings(dict[Value, bytes]):
    """The encoded value of each number that was asked for; looked up like a dictionary that has all of them."""

    __slots__ = ("_syntax", "cell")

    def __init__(self, cell: Callable[[Value], CellValue], syntax: Syntax) -> None:
        """`cell` gives the value in the MIB, None when the number has none there."""
        super().__init__()
        self.cell = cell
        self._syntax = syntax

    def __missing__(self, number: Value) -> bytes:
        cell = self.cell(number)
        if cell is None:
            raise KeyError(number)
        made = wire.value(self._syntax, cell)
        if len(self) >= MOST_KEPT:
            self.clear()
        self[number] = made
        return made


@cache
def of_numbers(syntax: Syntax, scale: int) -> Encodings:
    """Whole numbers of the scaled unit."""

    def cell(value: Value) -> int | None:
        scaled = value * scale
        if not math.isfinite(scaled):
            return None
        number = round(scaled)
        return number if in_range(syntax, number) else None

    return Encodings(cell, syntax)


@cache
def of_bits(words: int) -> Encodings:
    """Bits of so many registers."""
    size = 16 * words

    def cell(value: Value) -> bytes | None:
        if not 0 <= value < 1 << size:
            return None
        # RFC 2578 §7.1.4: bit 0 is the most significant bit of the first octet.
        return int(f"{int(value):0{size}b}"[::-1], 2).to_bytes(2 * words, "big")

    return Encodings(cell, Syntax.BITS)
