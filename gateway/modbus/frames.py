"""Finding RTU frames in what a line gave, whatever surrounds them.

An RTU frame is address, PDU and CRC, 4 to 256 bytes (Modbus over Serial Line V1.02, §2.5.1); it has no
start mark, and adapters do not keep the silences that should delimit it. So every offset may start a frame,
and only address, function, exact size and CRC together make one.

Rule 1: the reply that is waited for is looked for at every offset, and the one that is complete first wins.
        So the answer depends on the bytes alone, never on how they were split.
Rule 2: all other bytes are explained afterwards, from the left: echo of the request, frame of another unit,
        frame of the same unit that does not answer the request, damaged reply, noise. This is for
        counters and for the reason of a failure; no value is ever taken from there.
Rule 3: 256 bytes decide about an offset, so older bytes need not be kept.

Known are the sizes of the replies of functions 1 to 6, 15, 16 and 2B/0E and of exceptions.
"""

from __future__ import annotations

from dataclasses import dataclass

from gateway.modbus.crc import append_crc, crc_ok
from gateway.modbus.pdu import MAX_PDU, Function, expected_reply_size, least_identification_size, reply_fits

MAX_FRAME = MAX_PDU + 3
"""Bytes in the longest RTU frame: address, PDU, CRC."""

EXCEPTION_FRAME = 5
"""Bytes of an exception reply with address and CRC, the shortest reply there is."""

UNIT_ADDRESSES = range(1, 248)
"""Addresses of single devices (Serial Line §2.2); 0 is broadcast, 248 to 255 are reserved."""

_EXCEPTION_BIT = 0x80
_BYTE_COUNTED = frozenset((1, 2, 3, 4))
_EIGHT_BYTES = frozenset((5, 6, 15, 16))


def _size_at(buffer: bytearray, at: int) -> int:
    """Bytes of the whole reply frame of any unit that is at `at`, or 0 when none is, or not whole yet."""
    left = len(buffer) - at
    if left < EXCEPTION_FRAME or buffer[at] not in UNIT_ADDRESSES:
        return 0
    function = buffer[at + 1]
    if function in _BYTE_COUNTED:
        size = EXCEPTION_FRAME + buffer[at + 2]
    elif function in _EIGHT_BYTES:
        size = 8
    elif function == Function.READ_IDENTIFICATION:
        size = 3 + least_identification_size(buffer[at + 1 : at + 1 + MAX_PDU])
    elif function & _EXCEPTION_BIT and function != _EXCEPTION_BIT:
        size = EXCEPTION_FRAME
    else:
        return 0
    return size if size <= min(left, MAX_FRAME) else 0


@dataclass(frozen=True, slots=True)
class Found:
    """A frame that answers the request: `buffer[start:end]`."""

    start: int
    end: int


@dataclass(slots=True)
class Survey:
    """What the bytes were that are not the reply."""

    noise_bytes: int = 0
    wrong_unit: int = 0
    mismatch: int = 0
    damaged: int = 0  # the head of the reply at its full size, with a wrong CRC
    maybe_damaged: int = 0  # its size without its head, or the head of an exception
    echoes: int = 0

    def add(self, other: Survey) -> None:
        """Add the counts of another stretch of bytes."""
        self.noise_bytes += other.noise_bytes
        self.wrong_unit += other.wrong_unit
        self.mismatch += other.mismatch
        self.damaged += other.damaged
        self.maybe_damaged += other.maybe_damaged
        self.echoes += other.echoes


@dataclass(frozen=True, slots=True)
class Exchange:
    """A request on the wire and the shape of what answers it."""

    address: int
    request: bytes  # PDU
    sent: bytes  # frame
    reply_size: int | None  # bytes of the normal reply frame; None: its content decides
    echo_is_reply: bool  # a copy of the request would pass for its reply (functions 05 and 06, some coil reads)

    @classmethod
    def of(cls, address: int, request: bytes) -> Exchange:
        """Prepare a request PDU; raises as `pdu.expected_reply_size`, ValueError for an address out of 1..247."""
        if address not in UNIT_ADDRESSES:
            raise ValueError(f"address {address} is not in 1..247")
        size = expected_reply_size(request)
        return cls(
            address=address,
            request=request,
            sent=append_crc(bytes((address,)) + request),
            reply_size=None if size is None else size + 3,
            echo_is_reply=reply_fits(request, request),
        )

    @property
    def longest_reply(self) -> int:
        """Bytes of the longest frame that can answer."""
        return self.reply_size or MAX_FRAME

    def size_at(self, buffer: bytearray, at: int) -> int:
        """The least size that a reply starting at `at` can have, or 0 when none starts there.

        At the end of the buffer it may only be a beginning: compare with the bytes that are there.
        """
        head = buffer[at : at + 3]
        if not head or head[0] != self.address:
            return 0
        function = self.request[0]
        if len(head) == 1 or head[1] == function | _EXCEPTION_BIT:
            return EXCEPTION_FRAME
        if head[1] != function:
            return 0
        if self.reply_size is None:
            size = 3 + least_identification_size(buffer[at + 1 : at + 1 + MAX_PDU])
            return size if size <= MAX_FRAME else 0
        if len(head) == 3 and head[2] != self._third_byte():
            return 0
        return self.reply_size

    def _third_byte(self) -> int:
        """What follows the function: the byte count of a read, the address' high byte of a write."""
        if self.request[0] in _BYTE_COUNTED:
            assert self.reply_size is not None
            return self.reply_size - EXCEPTION_FRAME
        return self.request[1]

    def find(self, buffer: bytearray, start: int, known: int) -> Found | None:
        """The reply from offset `start` on that is complete first, among those not yet whole in `buffer[:known]`."""
        best: Found | None = None
        at = buffer.find(self.address, max(start, known - MAX_FRAME + 1))  # older offsets were decided before
        while 0 <= at <= len(buffer) - EXCEPTION_FRAME:
            size = self.size_at(buffer, at)
            end = at + size
            whole = size and known < end <= len(buffer) and (best is None or end < best.end)
            if whole and self._answers(bytes(buffer[at:end])):
                best = Found(at, end)
            at = buffer.find(self.address, at + 1)
        return best

    def _answers(self, frame: bytes) -> bool:
        return crc_ok(frame) and reply_fits(self.request, frame[1:-2])

    def survey(self, buffer: bytearray, start: int, end: int, *, last: bool) -> tuple[Survey, int]:
        """Explain `buffer[start:end]`, in which no reply is, from the left; also where it stopped.

        Unless these are the `last` bytes, it stops where a frame could still be unfinished.
        """
        seen = Survey()
        region = buffer[:end]
        at = run = start
        while at < end and (last or end - at >= MAX_FRAME):
            size = self._explain(region, at, seen)
            if not size and last and at == run:
                size = self._explain_whole(region, at, seen)
            if size:
                at += size
                run = at
            else:
                seen.noise_bytes += 1
                at += 1
        return seen, at

    def _explain(self, region: bytearray, at: int, seen: Survey) -> int:
        """Count the frame at `at` and return its size, or 0 when none is there."""
        if region.startswith(self.sent, at):
            seen.echoes += 1
            return len(self.sent)
        size = _size_at(region, at)
        if size and crc_ok(region[at : at + size]):
            if region[at] == self.address:
                seen.mismatch += 1
            else:
                seen.wrong_unit += 1
            return size
        size = self.size_at(region, at)
        if not 0 < size <= len(region) - at:
            return 0
        if region[at + 1] & _EXCEPTION_BIT:
            seen.maybe_damaged += 1
        else:
            seen.damaged += 1
        return size

    def _explain_whole(self, region: bytearray, at: int, seen: Survey) -> int:
        """Take all that is left as one frame: of a function or count we do not know, or hit in its first bytes."""
        size = len(region) - at
        if not EXCEPTION_FRAME - 1 <= size <= MAX_FRAME:
            return 0
        if region[at] in UNIT_ADDRESSES and crc_ok(region[at:]):
            if region[at] == self.address:
                seen.mismatch += 1
            else:
                seen.wrong_unit += 1
            return size
        if size == self.reply_size:
            seen.maybe_damaged += 1
            return size
        return 0
