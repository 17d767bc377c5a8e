"""The rows of tables, in the order of their indexes, as any number of columns have them.

A position is that of a row, from 0. Rows that somebody configured are kept (`Rows`). Those that follow from a device
and its map (conditions, entities) are a hundred a controller, so nothing is kept of one but its index, as a number and
as octets (15 bytes); everything else is made of that when it is asked for (`NumberedRows`).
"""

from __future__ import annotations

from array import array
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from itertools import accumulate
from typing import Protocol, TypeVar, overload

from gateway.core.site import Device
from gateway.faces.snmp import wire
from gateway.faces.snmp.objects import Row
from gateway.faces.snmp.settings import Oid

T = TypeVar("T")

ARC_BITS = 32
"""What an arc takes of the number of an index of two."""


class Places(Protocol):
    """The positions of rows by the octets of their indexes."""

    def get(self, suffix: bytes, /) -> int | None:
        """The position, None when there is no such row."""
        ...


class Rows:
    """Rows that are kept."""

    __slots__ = ("_devices", "_ends", "_rows", "_suffixes", "indexes", "places", "size")

    def __init__(self, rows: Iterable[tuple[Oid, Row]]) -> None:
        ordered = sorted(rows, key=lambda each: each[0])
        self.size = len(ordered)
        self.indexes: Sequence[Oid] = [index for index, _ in ordered]
        self._rows = [row for _, row in ordered]
        self._suffixes = [wire.arcs(index) for index in self.indexes]
        self.places: Places = {suffix: at for at, suffix in enumerate(self._suffixes)}
        self._devices: list[Device | None] = [getattr(row, "device", None) for row in self._rows]
        self._ends = _ends(self._devices)

    def row(self, at: int) -> Row:
        """The row."""
        return self._rows[at]

    def suffix(self, at: int) -> bytes:
        """The octets of its index."""
        return self._suffixes[at]

    def device(self, at: int) -> Device | None:
        """Whose it is, where it is a device's."""
        return self._devices[at]

    def devices(self, start: int, end: int) -> set[Device | None]:
        """Whose the rows from one to before another are."""
        return set(self._devices[start:end])

    def pairs(self, start: int, end: int) -> Iterable[tuple[Device | None, bytes]]:
        """Device and octets of the index of each of these rows."""
        return zip(self._devices[start:end], self._suffixes[start:end], strict=True)

    def end(self, at: int) -> int:
        """Where the rows of somebody else begin."""
        return self._ends[at]

    def only(self, positions: Sequence[int]) -> Rows:
        """Some of the rows."""
        return Rows((self.indexes[at], self.row(at)) for at in positions)

    def behind(self, arcs: Oid) -> int:
        """The position of the first row whose index is behind these arcs."""
        return bisect_right(self.indexes, arcs)


def _ends(devices: Sequence[Device | None]) -> list[int]:
    ends = [len(devices)] * len(devices)
    for at in range(len(devices) - 2, -1, -1):
        ends[at] = ends[at + 1] if devices[at] is devices[at + 1] else at + 1
    return ends


class NumberedRows(Rows):
    """Rows that are made of their numbers: the arc of the index or, where it has two, `first << ARC_BITS | second`.

    Each unit has `stride` numbers, those of unit 0 are the gateway's own.
    """

    __slots__ = ("_make", "_model", "_numbers", "_octets", "_of", "_starts", "_stride", "_two")

    def __init__(
        self,
        numbers: Iterable[int],
        stride: int,
        row: Callable[[int, int], Row],
        device: Callable[[int], Device | None],
        model: Callable[[int], Hashable],
    ) -> None:
        """`row` makes the row of a unit and a number among its own, `device` tells whose rows the unit's are.

        `model` is the same for units that are alike (`kind`).
        """
        self._numbers = array("Q", sorted(numbers))
        self._stride = stride
        self._two = stride == 1 << ARC_BITS
        self._make = row
        self._of = device
        self._model = model
        self.size = len(self._numbers)
        self.indexes = _Made(self.size, self._index)
        octets = [wire.arcs(index) for index in self.indexes]
        self._octets = b"".join(octets)
        self._starts = array("I", accumulate(map(len, octets), initial=0))
        self.places = self

    def row(self, at: int) -> Row:
        """See `Rows`."""
        unit, number = divmod(self._numbers[at], self._stride)
        return self._make(unit, number)

    def suffix(self, at: int) -> bytes:
        """See `Rows`."""
        return self._octets[self._starts[at] : self._starts[at + 1]]

    def kind(self, at: int) -> Hashable:
        """What the row has in common with those of other units: its model and its number among the unit's own."""
        unit, number = divmod(self._numbers[at], self._stride)
        return self._model(unit), number

    def device(self, at: int) -> Device | None:
        """See `Rows`."""
        return self._of(self._numbers[at] // self._stride)

    def devices(self, start: int, end: int) -> set[Device | None]:
        """See `Rows`."""
        found = set()
        while start < end:
            found.add(self.device(start))
            start = self.end(start)
        return found

    def pairs(self, start: int, end: int) -> Iterable[tuple[Device | None, bytes]]:
        """See `Rows`."""
        return ((self.device(at), self.suffix(at)) for at in range(start, end))

    def end(self, at: int) -> int:
        """See `Rows`."""
        return bisect_left(self._numbers, (self._numbers[at] // self._stride + 1) * self._stride)

    def only(self, positions: Sequence[int]) -> Rows:
        """See `Rows`."""
        return NumberedRows((self._numbers[at] for at in positions), self._stride, self._make, self._of, self._model)

    def behind(self, arcs: Oid) -> int:
        """See `Rows`."""
        if len(arcs) < 1 + self._two:
            return bisect_left(self._numbers, arcs[0] << ARC_BITS) if arcs else 0
        return bisect_right(self._numbers, self._number(arcs))

    def get(self, suffix: bytes, /) -> int | None:
        """See `Places`."""
        arcs: list[int] = []
        arc = 0
        for octet in suffix[:10]:  # of two arcs of five octets
            arc = arc << 7 | octet & 0x7F
            if octet < 0x80:
                arcs.append(arc)
                arc = 0
        if len(arcs) != 1 + self._two:
            return None
        number = self._number(tuple(arcs))
        at = bisect_left(self._numbers, number)
        # An arc has one form only: whatever else was read for it here is no name that we have.
        return at if at < self.size and self._numbers[at] == number and self.suffix(at) == suffix else None

    def _number(self, arcs: Oid) -> int:
        return arcs[0] << ARC_BITS | arcs[1] if self._two else arcs[0]

    def _index(self, at: int) -> Oid:
        number = self._numbers[at]
        return divmod(number, self._stride) if self._two else (number,)


class _Made(Sequence[T]):
    """A sequence whose items are made when they are asked for."""

    __slots__ = ("_make", "_size")

    def __init__(self, size: int, make: Callable[[int], T]) -> None:
        self._size = size
        self._make = make

    def __len__(self) -> int:
        return self._size

    @overload
    def __getitem__(self, at: int) -> T: ...

    @overload
    def __getitem__(self, at: slice) -> list[T]: ...

    def __getitem__(self, at: int | slice) -> T | list[T]:
        if isinstance(at, slice):
            return [self._make(each) for each in range(*at.indices(self._size))]
        return self._make(at)

    def __iter__(self) -> Iterator[T]:
        return map(self._make, range(self._size))
