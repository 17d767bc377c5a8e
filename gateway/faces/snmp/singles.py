"""GET and GETNEXT of one cell, answered without being taken apart.

A request is its beginning up to the octets of the request id, that id, and a tail: error status, error index and a list
of one name with NULL. Rules:

1. A beginning is known when a request with it was read whole and answered. It fixes version, community or scope, kind
   and, by its lengths, the size of the tail; and so every octet of the tail but those of the name.
2. All these octets are compared, and the name has to be that of a cell of the window, so what is answered here is as
   well-formed as what was read whole.
3. Nothing of the reply is kept: the varbind is the cell's own, as it is now. Whatever is not a plain value (end of the
   view, no such instance) is left to the long way.
4. Beginnings are few, and bounded by MOST_BEGINNINGS.
"""

from __future__ import annotations

from gateway.faces.snmp import reader, wire
from gateway.faces.snmp.reader import Request
from gateway.faces.snmp.tree import Window

MOST_BEGINNINGS = 512
MOST_TAIL = 0x87
"""Octets of a tail whose lengths still take one octet each."""

_RESULT = b"\x02\x01\x00\x02\x01\x00"
_NULL = b"\x05\x00"


class Single:
    """A known beginning; `head` is what stands before the PDU in a message with a community, None for a bare PDU."""

    __slots__ = ("_envelopes", "_frame", "_head", "_id_size", "_next", "_size", "grant", "room", "window")

    def __init__(
        self, window: Window, request: Request, size: int, *, room: int, head: bytes | None, grant: object
    ) -> None:
        self.window = window
        self.grant = grant
        self.room = room
        self._size = size  # of the tail
        self._frame = _RESULT + wire.head(0x30, size - 8) + wire.head(0x30, size - 10) + wire.head(0x06, size - 14)
        self._head = head
        self._next = request.kind == reader.GET_NEXT
        self._id_size = len(request.request_id) - 2
        self._envelopes: dict[int, tuple[bytes, bytes]] = {}  # by the size of the varbind

    def reply(self, data: bytes, at: int, now: float) -> bytes | None:
        """The reply to a request whose request id begins at `at`, None when it takes the long way."""
        window = self.window
        tail = at + self._id_size
        if len(data) != tail + self._size or not data.startswith(self._frame, tail) or not data.endswith(_NULL):
            return None
        place = window.find(data[tail + 12 : -2])
        if place is None:
            return None
        number, position = place
        column = window.columns[number]
        if self._next:
            position += 1
            varbind = column.varbind(position, now) if position < column.size else None
            if varbind is None:
                window.refresh()
                found = window.from_place(window.starts[number] + position, now)
                varbind = found[1] if found is not None else None
        else:
            varbind = column.varbind(position, now)
        if varbind is None:
            return None
        envelope = self._envelopes.get(len(varbind))
        if envelope is None:
            if len(varbind) > self.room:
                return None
            envelope = self._envelopes[len(varbind)] = self._enveloped(len(varbind))
        return envelope[0] + data[at:tail] + envelope[1] + varbind

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
        """Learn from a GET or GETNEXT of one name that ends with `data` and was answered in `window`."""
        size = len(data) - request.id_at - len(request.request_id) + 2
        if size > MOST_TAIL:
            return
        beginning = data[: request.id_at]
        known = self.known.get(beginning)
        if known is None or known.grant is not grant or known.window is not window or known.room != room:
            if len(self.known) >= MOST_BEGINNINGS:
                del self.known[next(iter(self.known))]
            self.known[beginning] = Single(window, request, size, room=room, head=head, grant=grant)
