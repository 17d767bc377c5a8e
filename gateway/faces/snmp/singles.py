"""GET and GETNEXT of one cell, answered without being taken apart again.

A request is its beginning up to the octets of the request id, that id, and a tail: error status, error index and the
one name. Rules:

1. A beginning is known when a request with it was read whole and answered: it fixes version, community or scope, kind
   and, by its lengths, the size of the tail. A tail is known when a request with it was read whole: it names one cell.
2. Beginning and tail are compared octet by octet with what is known, so a request made of a known beginning and a
   known tail of the right size is as well-formed as those two were.
3. Nothing of the reply is kept: the varbind is the cell's own, as it is now. Whatever is not a plain value (end of the
   view, no such instance) is left to the long way.
4. Tails are kept in the window, at most one a cell; beginnings are few, and bounded by MOST_BEGINNINGS.
"""

from __future__ import annotations

from gateway.faces.snmp import reader, wire
from gateway.faces.snmp.reader import Request
from gateway.faces.snmp.tree import Window

MOST_BEGINNINGS = 512
_RESULT = b"\x02\x01\x00\x02\x01\x00"


class Single:
    """A known beginning; `head` is what stands before the PDU in a message with a community, None for a bare PDU."""

    __slots__ = ("_envelopes", "_head", "_id_size", "_next", "grant", "room", "tail_size", "window")

    def __init__(
        self, window: Window, request: Request, tail_size: int, *, room: int, head: bytes | None, grant: object
    ) -> None:
        self.window = window
        self.grant = grant
        self.room = room
        self.tail_size = tail_size
        self._head = head
        self._next = request.kind == reader.GET_NEXT
        self._id_size = len(request.request_id) - 2
        self._envelopes: dict[int, tuple[bytes, bytes]] = {}  # by the size of the varbind

    def reply(self, request_id: bytes, tail: bytes, now: float) -> bytes | None:
        """The reply, None when it takes the long way; `request_id` are the octets of it."""
        window = self.window
        place = window.tails.get(tail)
        if place is None or len(tail) != self.tail_size:
            return None
        if self._next:
            place += 1
            if place == len(window.slots):
                return None
            varbind = window.slots[place].varbind(now)
            if varbind is None:
                window.refresh()
                found = window.from_place(place + 1, now)
                varbind = found[1] if found is not None else None
        else:
            varbind = window.slots[place].varbind(now)
        if varbind is None:
            return None
        envelope = self._envelopes.get(len(varbind))
        if envelope is None:
            if len(varbind) > self.room:
                return None
            envelope = self._envelopes[len(varbind)] = self._enveloped(len(varbind))
        return envelope[0] + request_id + envelope[1] + varbind

    def _enveloped(self, size: int) -> tuple[bytes, bytes]:
        """What stands before and behind the octets of the request id, before a varbind of this size."""
        behind = _RESULT + wire.head(0x30, size)
        before = wire.head(0x02, self._id_size)
        before = wire.head(wire.RESPONSE, len(before) + self._id_size + len(behind) + size) + before
        if self._head is not None:
            whole = len(self._head) + len(before) + self._id_size + len(behind) + size
            before = wire.head(0x30, whole) + self._head + before
        return before, behind


class Singles:
    """The known beginnings."""

    def __init__(self) -> None:
        self.known: dict[bytes, Single] = {}

    def learn(
        self, data: bytes, request: Request, window: Window, *, room: int, head: bytes | None, grant: object
    ) -> None:
        """Learn from a request that ends with `data` and was answered in `window`."""
        if request.kind == reader.GET_BULK or len(request.names) != 1 or not request.id_at:
            return
        place = window.places.get(request.names[0])
        if place is None:
            return
        at = request.id_at + len(request.request_id) - 2
        window.tails[data[at:]] = place
        beginning = data[: request.id_at]
        known = self.known.get(beginning)
        if known is None or known.grant is not grant or known.window is not window or known.room != room:
            if len(self.known) >= MOST_BEGINNINGS:
                del self.known[next(iter(self.known))]
            self.known[beginning] = Single(window, request, len(data) - at, room=room, head=head, grant=grant)
