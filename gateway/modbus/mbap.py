"""MBAP: cutting a TCP byte stream into ADUs.

An ADU is transaction id, protocol id, length (2 bytes each), unit id and PDU; the length counts unit id and
PDU (Messaging on TCP/IP V1.0b, §3.1.3).

Rule 1: a length below 2 or above 254 means that the framing is lost: nothing after it can be trusted.
Rule 2: an ADU with another protocol id than 0 is skipped whole and counted (§4.4.2.2: discarded); three in a
        row mean that the peer speaks something else, and the framing is lost.
Rule 3: once the framing is lost, nothing more is taken or kept. ADUs before the loss still count.
Rule 4: at most one unfinished ADU is kept, 260 bytes.
Rule 5: the same bytes give the same ADUs however they are split.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

MAX_ADU = 260
"""Bytes in the longest ADU: 7 of header, 253 of PDU."""

_HEADER = struct.Struct(">HHHB")
_PREFIX = struct.Struct(">HHH")  # what the length does not count
_LENGTHS = range(2, 255)
_FOREIGN_LIMIT = 3


class Adu(NamedTuple):
    """One request or reply: transaction id 0..65535, unit id 0..255, PDU of 1..253 bytes."""

    tid: int
    unit: int
    pdu: bytes


def encode(tid: int, unit: int, pdu: bytes) -> bytes:
    """The bytes of an ADU; `pdu` has 1..253 bytes."""
    return _HEADER.pack(tid, 0, len(pdu) + 1, unit) + pdu


class MbapSplitter:
    """Cuts one connection's bytes into ADUs.

    `lost` is None, or why the framing was lost ("length", "protocol"): answer what came before, then close.
    `foreign` counts the ADUs that were skipped for their protocol id.
    """

    __slots__ = ("_buffer", "_foreign_run", "foreign", "lost")

    def __init__(self) -> None:
        self.lost: str | None = None
        self.foreign = 0
        self._foreign_run = 0
        self._buffer = b""

    @property
    def pending(self) -> int:
        """Bytes kept of an unfinished ADU; at most 259."""
        return len(self._buffer)

    def begins(self, tid: int) -> bool:
        """Whether the unfinished ADU, as far as it is there, can be one with this transaction id."""
        head = _PREFIX.pack(tid, 0, 0)[:5]  # no ADU is so long that the length's first byte is not 0
        return head.startswith(self._buffer[: len(head)])

    def feed(self, data: bytes) -> list[Adu]:
        """Take received bytes and return the ADUs that they complete, in order."""
        if self.lost is not None:
            return []
        # One whole ADU in one segment is what nearly every client sends.
        if not self._buffer and len(data) > _HEADER.size:
            tid, protocol, length, unit = _HEADER.unpack_from(data)
            if protocol == 0 and length == len(data) - _PREFIX.size and length in _LENGTHS:
                self._foreign_run = 0
                return [Adu(tid, unit, data[_HEADER.size :])]
        return self._split(self._buffer + data)

    def _split(self, data: bytes) -> list[Adu]:
        adus: list[Adu] = []
        at = 0
        while len(data) - at >= _PREFIX.size:
            tid, protocol, length = _PREFIX.unpack_from(data, at)
            if length not in _LENGTHS:
                return self._lose("length", adus)
            end = at + _PREFIX.size + length
            if end > len(data):
                break
            if protocol == 0:
                self._foreign_run = 0
                adus.append(Adu(tid, data[at + 6], data[at + 7 : end]))
            else:
                self.foreign += 1
                self._foreign_run += 1
                if self._foreign_run == _FOREIGN_LIMIT:
                    return self._lose("protocol", adus)
            at = end
        self._buffer = data[at:]
        return adus

    def _lose(self, reason: str, adus: list[Adu]) -> list[Adu]:
        self.lost = reason
        self._buffer = b""
        return adus
