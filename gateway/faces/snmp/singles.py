"""GET and GETNEXT of one cell, answered without being taken apart.

A request is its beginning up to the octets of the request id, that id, and a tail: error status, error index and a list
of one name with NULL. Rules:

1. A beginning is known when a request with it was read whole and answered. It fixes version, community or scope, kind
   and, by its lengths, the size of the tail; and so every octet of the tail but those of the name.
2. All these octets are compared, and a name that is not that of a cell of the window is read octet by octet, so what is
   answered here is as well-formed as what was read whole.
3. Nothing of the reply is kept: it is read as the long way would, as it is now. What is an error is left to the long
   way.
4. Cells of points that are numbers, nearly all that is asked for, are read in a shorter way (`routes.py`): a look-up
   each of the column, the row, the number in the device's snapshot, and its octets. Where one of them finds nothing,
   the cell is read as any other.
5. Beginnings are few, and bounded by MOST_BEGINNINGS.
"""

from __future__ import annotations

from gateway.core.snapshot import DeviceState
from gateway.faces.snmp import reader, wire
from gateway.faces.snmp.reader import NotSnmp, Request
from gateway.faces.snmp.reading import Reading
from gateway.faces.snmp.routes import Route
from gateway.faces.snmp.tree import Window

MOST_BEGINNINGS = 512
MOST_TAIL = 0x87
"""Octets of a tail whose lengths still take one octet each."""

MOST_NUMBER = 16
"""Octets of an encoded number, its identifier and length among them, are fewer."""

_RESULT = b"\x02\x01\x00\x02\x01\x00"
_NULL = b"\x05\x00"
_ONLINE = DeviceState.ONLINE
_join = b"".join

Way = tuple[object, slice, slice, slice, dict[bytes, Route], dict[int, tuple[bytes, bytes]], "Single"]
"""Of a beginning: who may use it, where the request id, frame with prefix, and index with NULL are, the ways to
columns, and what stands before and behind the request id, by the octets of the value."""


class Single:
    """A known beginning; `head` is what stands before the PDU in a message with a community, None for a bare PDU."""

    __slots__ = ("_ahead", "_at", "_frame", "_head", "_id_size", "_size", "grant", "room", "way", "window")

    def __init__(
        self, window: Window, request: Request, size: int, *, room: int, head: bytes | None, grant: object
    ) -> None:
        self.window = window
        self.grant = grant
        self.room = room
        self._size = size  # of the tail
        self._frame = _RESULT + wire.head(0x30, size - 8) + wire.head(0x30, size - 10) + wire.head(0x06, size - 14)
        self._head = head
        self._ahead = int(request.kind == reader.GET_NEXT)
        self._at = request.id_at
        self._id_size = len(request.request_id) - 2
        tail = self._at + self._id_size
        index = tail + len(self._frame) + window.routes.prefix_size
        self.way: Way = (
            grant,
            slice(self._at, tail),
            slice(tail, index),
            slice(index, None),
            window.routes.of(self._frame, self._ahead),
            {},
            self,
        )

    def reply(self, data: bytes, now: float) -> bytes | None:
        """The reply to a request for whatever there is, None when it takes the long way."""
        _, id_at, column_at, _, routes, envelopes, _ = self.way
        tail = column_at.start
        if len(data) != tail + self._size or not data.startswith(self._frame, tail) or not data.endswith(_NULL):
            return None
        name = data[tail + len(self._frame) - 2 : -2]
        window = self.window
        window.refresh()
        reading = Reading(window, now)
        try:
            varbind, _ = reading.next(name) if self._ahead else reading.get(name)
        except NotSnmp:
            return None
        if len(varbind) > self.room:
            return None
        first = reader.content(varbind, 0, len(varbind), 0x30)[0]
        name_end = reader.content(varbind, first, len(varbind), 0x06)[1]
        value_size = len(varbind) - name_end
        before, behind = self._enveloped(value_size, name_end - first)
        if value_size <= MOST_NUMBER and name_end - first == len(name):
            envelopes[value_size] = before, behind
            if data[column_at] not in routes:
                found = window.find(name[2:])
                if found is not None:
                    column = window.columns[found[0]]
                    window.routes.learn(self._frame, self._ahead, column, len(name) - 2 - len(column.prefix))
        return before + data[id_at] + behind + varbind[first:]

    def _enveloped(self, value_size: int, name_size: int) -> tuple[bytes, bytes]:
        """What stands before and behind the octets of the request id, up to the name."""
        size = value_size + name_size
        behind = wire.head(0x30, size)
        behind = _RESULT + wire.head(0x30, len(behind) + size) + behind
        before = wire.head(0x02, self._id_size)
        before = wire.head(wire.RESPONSE, len(before) + self._id_size + len(behind) + size) + before
        if self._head is not None:
            whole = len(self._head) + len(before) + self._id_size + len(behind) + size
            before = wire.head(0x30, whole) + self._head + before
        return before, behind


class Singles:
    """The known beginnings."""

    def __init__(self) -> None:
        self.known: dict[bytes, Way] = {}
        self.usual = slice(0)  # the beginning of a message with a community, if it is as long as the last one was

    def reply(self, way: Way, data: bytes, grant: object, now: float) -> bytes | None:
        """The reply to a request that begins like this by who has these rights, None when it takes the long way."""
        granted, id_at, column_at, row_at, routes, envelopes, single = way
        if granted is not grant:
            return None
        try:
            rows, point, encodings, name = routes[data[column_at]]
            device, index = rows[data[row_at]]
            snapshot = device.snapshot
            if snapshot.state is _ONLINE:
                value = encodings[snapshot.values[point]]
                before, behind = envelopes[len(value)]
                return _join((before, data[id_at], behind, name, index, value))
        except KeyError:
            pass
        try:
            return single.reply(data, now)
        except Exception:  # noqa: BLE001 - the long way meets the same defect, says so, and answers
            return None

    def learn(
        self, data: bytes, request: Request, window: Window, *, room: int, head: bytes | None, grant: object
    ) -> None:
        """Learn from a GET or GETNEXT of one name that ends with `data` and was answered in `window`."""
        size = len(data) - request.id_at - len(request.request_id) + 2
        if size > MOST_TAIL:
            return
        beginning = data[: request.id_at]
        known = self.known.get(beginning)
        if known is not None:
            single = known[-1]
            if single.grant is grant and single.window is window and single.room == room:
                return
        elif len(self.known) >= MOST_BEGINNINGS:
            del self.known[next(iter(self.known))]
        self.known[beginning] = Single(window, request, size, room=room, head=head, grant=grant).way
