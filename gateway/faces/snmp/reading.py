"""GET, GETNEXT and GETBULK in one window at one moment: RFC 3416 §4.2.1-4.2.3.

A `Reading` is made for one request. It remembers which cells it looked at, so that its caller can tell what the
result depends on.
"""

from __future__ import annotations

from gateway.core.site import Device
from gateway.faces.snmp import reader, wire
from gateway.faces.snmp.tree import Window

MOST_CELLS = 1000
"""Of a result made from more cells than this nothing is told: it would cost too much to find out."""


class Reading:
    """What one request finds; names are encoded OIDs, varbinds encoded VarBinds."""

    __slots__ = ("_now", "_window", "spans")

    def __init__(self, window: Window, now: float) -> None:
        self._window = window
        self._now = now
        self.spans: list[tuple[int, int]] = []  # places looked at, the end not among them

    def get(self, name: bytes) -> tuple[bytes, bool]:
        """The varbind for a name, and whether it has a value."""
        window = self._window
        place = window.places.get(name)
        if place is not None:
            self.spans.append((place, place + 1))
            varbind = window.slots[place].varbind(self._now)
            if varbind is not None:
                return varbind, True
            return wire.varbind(name, wire.NO_SUCH_INSTANCE), False
        missing = wire.NO_SUCH_INSTANCE if window.has_object(reader.oid(name)) else wire.NO_SUCH_OBJECT
        return wire.varbind(name, missing), False

    def next(self, name: bytes) -> tuple[bytes, bool]:
        """The varbind behind a name, and whether there is one."""
        start = self._behind(name)
        found = self._window.from_place(start, self._now)
        if found is None:
            self.spans.append((start, len(self._window.slots)))
            return wire.varbind(name, wire.END_OF_MIB_VIEW), False
        self.spans.append((start, found[0] + 1))
        return found[1], True

    def bulk(self, request: reader.Request, room: int) -> bytes | None:
        """As many varbinds as fit `room`, in the order of RFC 3416 §4.2.3; None when not even the first does."""
        names = request.names
        single = min(request.first, len(names)) if request.first > 0 else 0
        out: list[bytes] = []
        left = room
        for name in names[:single]:
            varbind = self.next(name)[0]
            left -= len(varbind)
            if left < 0:
                return b"".join(out) if out else None
            out.append(varbind)
        repeaters = names[single:]
        if not repeaters or request.second <= 0:
            return b"".join(out)
        starts = [self._behind(name) for name in repeaters]
        ends = starts.copy()
        if len(repeaters) == 1:
            self._column(repeaters[0], ends, request.second, left, out)
        else:
            self._columns(repeaters, ends, request.second, left, out)
        self.spans += zip(starts, ends, strict=True)
        return b"".join(out) if out else None

    def devices(self) -> list[Device] | None:
        """The devices that the result depends on; None when it depends on more than snapshots, or too many cells."""
        slots = self._window.slots
        watched: set[object] = set()
        cells = 0
        for start, end in self.spans:
            cells += end - start
            if cells > MOST_CELLS:
                return None
            watched.update([slot.watched for slot in slots[start:end]])
        return None if None in watched else [each for each in watched if isinstance(each, Device)]

    def _behind(self, name: bytes) -> int:
        """The first place behind a name."""
        place = self._window.places.get(name)
        return self._window.place_after(reader.oid(name)) if place is None else place + 1

    def _column(self, name: bytes, ends: list[int], repetitions: int, left: int, out: list[bytes]) -> None:
        """`repetitions` steps behind one name, as far as they fit."""
        window, now = self._window, self._now
        slots = window.slots
        at, stop = ends[0], len(slots)
        for _ in range(repetitions):
            varbind = slots[at].varbind(now) if at < stop else None
            if varbind is None:
                found = window.from_place(at + 1, now)
                if found is None:
                    ends[0] = stop
                    varbind = wire.varbind(name, wire.END_OF_MIB_VIEW)
                    if len(varbind) <= left:
                        out.append(varbind)
                    return
                at, varbind = found
            name = slots[at].name
            at += 1
            ends[0] = at
            left -= len(varbind)
            if left < 0:
                return
            out.append(varbind)

    def _columns(self, names: list[bytes], places: list[int], repetitions: int, left: int, out: list[bytes]) -> None:
        """The same behind several names in turn."""
        window, now = self._window, self._now
        slots, from_place = window.slots, window.from_place
        for _ in range(repetitions):
            ended = True
            for position, place in enumerate(places):
                found = from_place(place, now)
                if found is None:
                    varbind = wire.varbind(names[position], wire.END_OF_MIB_VIEW)
                    places[position] = len(slots)
                else:
                    at, varbind = found
                    places[position] = at + 1
                    names[position] = slots[at].name
                    ended = False
                left -= len(varbind)
                if left < 0:
                    return
                out.append(varbind)
            if ended:
                return
