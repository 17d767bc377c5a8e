"""Replies ready for the wire, found by the request's own bytes.

Rule 1: the key is a whole request without its transaction id (protocol id, length, unit, PDU), the value
        a whole reply without it. A key is only kept for a request that was cut, routed, allowed and
        answered from memory, so equal bytes need none of these checks again.
Rule 2: an entry is right only before its time is up and while its device still has the very snapshot
        it was made from. Whoever takes one checks both (`Entry`).
Rule 3: the memory is bounded. When it is full it is emptied: what is asked often is back at once.
"""

from __future__ import annotations

from gateway.core.serving import FromMemory
from gateway.core.site import Device

Entry = tuple[float, Device, object, bytes]
"""(monotonic time until which it is valid, device, mark of its snapshot then, reply); a bare tuple for speed."""

CAPACITY = 4096


class HotReplies:
    """Bounded memory of replies; `find` is the dictionary's own method."""

    __slots__ = ("_capacity", "_entries", "find")

    def __init__(self, capacity: int = CAPACITY) -> None:
        self._capacity = capacity
        self._entries: dict[bytes, Entry] = {}
        self.find = self._entries.get

    def __len__(self) -> int:
        return len(self._entries)

    def clear(self) -> None:
        """Forget all."""
        self._entries.clear()

    def keep(self, request: bytes, device: Device, made: FromMemory, reply: bytes) -> None:
        """Keep `reply` for `request`; both without transaction id."""
        if len(self._entries) >= self._capacity and request not in self._entries:
            self._entries.clear()
        self._entries[request] = (made.valid_until, device, made.mark, reply)
