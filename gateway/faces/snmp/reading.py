"""GET, GETNEXT and GETBULK in one window at one moment: RFC 3416 §4.2.1-4.2.3.

A `Reading` is made for one request. It remembers which cells it looked at, so that its caller can tell what the
result depends on.
"""

from __future__ import annotations

from collections.abc import Iterator

from gateway.core.site import Device
from gateway.faces.snmp import reader, wire
from gateway.faces.snmp.tree import Window

MOST_CELLS = 1000
"""Of a result made from more cells than this nothing is told: it would cost too much to find out."""


RUN = 64
"""So many cells of a column are read at once, some of which may be too many for the reply."""


class Reading:
    """What one request finds; names are encoded OIDs, varbinds encoded VarBinds."""

    __slots__ = ("_lasts", "_now", "_window", "spans")

    def __init__(self, window: Window, now: float) -> None:
        self._window = window
        self._now = now
        self.spans: list[tuple[int, int]] = []  # places looked at, the end not among them
        self._lasts = True  # nothing was looked for in what changes without a snapshot

    def get(self, name: bytes) -> tuple[bytes, bool]:
        """The varbind for a name, and whether it has a value."""
        window = self._window
        found = window.find(name[2:])
        if found is not None:
            number, at = found
            place = window.starts[number] + at
            self.spans.append((place, place + 1))
            varbind = window.columns[number].varbind(at, self._now)
            if varbind is not None:
                return varbind, True
            return wire.varbind(name, wire.NO_SUCH_INSTANCE), False
        oid = reader.oid(name)
        varbind = window.tails.get(oid, self._now)
        self._lasts = self._lasts and not window.tails.tails
        if varbind is not None:
            return varbind, True
        missing = wire.NO_SUCH_INSTANCE if window.has_object(oid) else wire.NO_SUCH_OBJECT
        return wire.varbind(name, missing), False

    def next(self, name: bytes) -> tuple[bytes, bool]:
        """The varbind behind a name, and whether there is one."""
        start = self._behind(name)
        found = self._window.from_place(start, self._now)
        if found is None:
            self.spans.append((start, self._window.size))
            step = next(self._steps(name), None)
            return (step[1], True) if step is not None else (wire.varbind(name, wire.END_OF_MIB_VIEW), False)
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
        if not self._lasts:
            return None
        window = self._window
        watched: set[Device] = set()
        cells = 0
        for start, end in self.spans:
            cells += end - start
            if cells > MOST_CELLS:
                return None
            place = start
            while place < end:
                number, at = window.locate(place)
                many = min(end, window.starts[number + 1]) - place
                found = window.columns[number].watched(at, at + many)
                if found is None:
                    return None
                watched.update(found)
                place += many
        return list(watched)

    def _steps(self, name: bytes) -> Iterator[tuple[bytes, bytes]]:
        """Name and varbind of each cell of the tails behind a name."""
        tails = self._window.tails
        if tails.tails:
            self._lasts = False
            yield from tails.steps(reader.oid(name), self._now)

    def _behind(self, name: bytes) -> int:
        """The first place behind a name."""
        window = self._window
        found = window.find(name[2:])
        return window.place_after(reader.oid(name)) if found is None else window.starts[found[0]] + found[1] + 1

    def _column(self, name: bytes, ends: list[int], repetitions: int, left: int, out: list[bytes]) -> None:
        """`repetitions` steps behind one name, as far as they fit."""
        window, now = self._window, self._now
        place, last, done = ends[0], name, 0
        while done < repetitions:
            found = window.from_place(place, now)
            if found is None:
                ends[0] = window.size
                self._rest(last, repetitions - done, left, out)
                return
            number, at = window.locate(found[0])
            column = window.columns[number]
            run = column.run(at + 1, min(at + repetitions - done, at + RUN, column.size), now)
            for varbind in (found[1], *run):
                left -= len(varbind)
                if left < 0:
                    ends[0] = found[0] + 1 + len(run)
                    return
                out.append(varbind)
            done += 1 + len(run)
            place = ends[0] = found[0] + 1 + len(run)
            last = column.name(at + len(run))

    def _rest(self, name: bytes, repetitions: int, left: int, out: list[bytes]) -> None:
        """`repetitions` steps behind a name that has only the tails behind it."""
        steps = self._steps(name)
        for _ in range(repetitions):
            step = next(steps, None)
            varbind = wire.varbind(name, wire.END_OF_MIB_VIEW) if step is None else step[1]
            left -= len(varbind)
            if left < 0:
                return
            out.append(varbind)
            if step is None:
                return
            name = step[0]

    def _columns(self, names: list[bytes], places: list[int], repetitions: int, left: int, out: list[bytes]) -> None:
        """The same behind several names in turn."""
        window, now = self._window, self._now
        from_place = window.from_place
        for _ in range(repetitions):
            ended = True
            for position, place in enumerate(places):
                found = from_place(place, now)
                if found is None:
                    step = next(self._steps(names[position]), None)
                    varbind = wire.varbind(names[position], wire.END_OF_MIB_VIEW) if step is None else step[1]
                    places[position] = window.size
                    if step is not None:
                        names[position] = step[0]
                        ended = False
                else:
                    at, varbind = found
                    places[position] = at + 1
                    number, at = window.locate(at)
                    names[position] = window.columns[number].name(at)
                    ended = False
                left -= len(varbind)
                if left < 0:
                    return
                out.append(varbind)
            if ended:
                return
