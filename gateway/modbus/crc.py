"""CRC-16/Modbus.

Polynomial 0x8005 reflected (0xA001), start value 0xFFFF, no final XOR; sent low byte first
(Modbus over Serial Line V1.02, §2.5.1.2 and appendix B). The CRC of a frame together with its CRC is 0.
"""

from __future__ import annotations

_POLYNOMIAL = 0xA001


def _row(index: int) -> int:
    for _ in range(8):
        index = (index >> 1) ^ _POLYNOMIAL if index & 1 else index >> 1
    return index


_TABLE = tuple(_row(index) for index in range(256))


def crc16(data: bytes | bytearray | memoryview) -> int:
    """CRC of `data` as a number; its low byte goes first on the wire."""
    crc = 0xFFFF
    table = _TABLE
    for byte in data:
        crc = (crc >> 8) ^ table[(crc ^ byte) & 0xFF]
    return crc


def append_crc(frame: bytes) -> bytes:
    """`frame` followed by its CRC, low byte first."""
    return frame + crc16(frame).to_bytes(2, "little")


def crc_ok(frame: bytes | bytearray | memoryview) -> bool:
    """Whether the last two bytes of `frame` are the CRC of the bytes before; False for less than 3 bytes."""
    return len(frame) > 2 and crc16(frame) == 0
