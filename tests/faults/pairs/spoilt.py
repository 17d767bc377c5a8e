"""What happens to the replies of an address, on a serial line or behind a Modbus TCP server."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Any

from gateway.modbus.crc import append_crc
from gateway.modbus.mbap import Adu
from gateway.simulator.medium import Burst
from gateway.simulator.upstream import Piece

LATE_S = {"late": 0.9, "very late": 3.0}
STRANGER = 0xC8


class Spoilt:
    """A `Medium` and a `Spoiler`: what happens to the next replies of an address, in this order."""

    def __init__(self) -> None:
        self.fates: dict[int, deque[str]] = {}
        self._free_at: dict[int, float] = {}

    def next(self, address: int, *fates: str) -> None:
        """Let this happen to its next replies."""
        self.fates.setdefault(address, deque()).extend(fates)

    def request(self, frame: bytes, ended_at: float) -> bytes:
        """See `Medium.request`."""
        del ended_at
        return frame

    def echo(self, frame: bytes, started_at: float) -> Sequence[Burst]:
        """See `Medium.echo`."""
        del frame, started_at
        return ()

    def _fate(self, address: int) -> str:
        fates = self.fates.get(address)
        return fates.popleft() if fates else ""

    def reply(self, *args: Any) -> Sequence[Any]:
        """See `Medium.reply` and `Spoiler.reply`."""
        if isinstance(args[0], Adu):
            return self._tcp_reply(*args[:3])
        return self._serial_reply(*args)

    def _serial_reply(self, frame: bytes, starts_at: float) -> Sequence[Burst]:
        address = frame[0]
        fate = self._fate(address)
        at = max(starts_at + LATE_S.get(fate, 0.0), self._free_at.get(address, starts_at))
        self._free_at[address] = at
        if fate == "lost":
            return ()
        if fate == "corrupt":
            frame = frame[:3] + bytes([frame[3] ^ 0x10]) + frame[4:]
        if fate == "foreign":
            frame = append_crc(bytes([STRANGER]) + frame[1:-2])
        return (Burst(at, frame),)

    def _tcp_reply(self, request: Adu, reply: bytes, at: float) -> Sequence[Piece]:
        fate = self._fate(request.unit)
        if fate == "lost":
            return ()
        at += LATE_S.get(fate, 0.0)
        if fate == "corrupt":
            return (Piece(at, reply[: len(reply) // 2]),)
        if fate == "foreign":
            reply = reply[:6] + bytes([STRANGER]) + reply[7:]
        if fate == "close":
            return (Piece(at, b"", "fin"),)
        return (Piece(at, reply),)
