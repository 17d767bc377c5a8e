"""What the RTU client saw on the wire, in bytes and frames."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(slots=True)
class RtuCounters:
    """Counts since start; each names one thing that can go wrong on a line."""

    noise_bytes: int = 0  # bytes that belong to no frame
    late_bytes: int = 0  # bytes that came while nobody waited
    wrong_unit: int = 0  # whole frames from another address while waiting
    mismatch: int = 0  # right CRC and address, wrong function, count or shape
    crc_errors: int = 0  # a reply of the right length with a wrong CRC
    echoes: int = 0  # our own request came back first (RS-485 local echo)
