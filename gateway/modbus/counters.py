"""What a line's client saw, in bytes, frames and connections."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field


@dataclass(slots=True)
class RtuCounters:
    """Counts since start; each names one thing that can go wrong on a line."""

    noise_bytes: int = 0  # bytes that belong to no frame
    late_bytes: int = 0  # bytes that came while nobody waited
    wrong_unit: int = 0  # whole frames from another address while waiting
    mismatch: int = 0  # right CRC and address, wrong function, count or shape
    crc_errors: int = 0  # a reply of the right length with a wrong CRC
    echoes: int = 0  # our own request came back first (RS-485 local echo)


@dataclass(slots=True)
class UpstreamCounters:
    """What became of the connections to a Modbus TCP upstream since start."""

    connections: int = 0
    refused: int = 0  # attempts that gave no connection
    late_replies: int = 0  # to requests that had been given up
    window: int = 1  # requests that may be under way at once, as learnt
    lost: Counter[str] = field(default_factory=Counter)  # why a connection ended → count; "finished" is as it should be
