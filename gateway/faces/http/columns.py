"""The values of one point of all devices of a model as sample lines.

A column writes the lines of many devices at once and keeps none of them: what is the same for all devices (how a line
begins, which states there are) is kept once a model, what is a device's own (its labels) once a device, and both are
put together by the join of bytes. That costs less than to write anew the lines that changed and keep the others, and a
site of hundreds of devices has no copy of its own exposition in memory.

A value that the map does not name (state 17, bit 9) is written while it lasts.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from operator import itemgetter

from gateway.devices.model import DeviceMap, Kind, Point, Value
from gateway.faces.http.text import escaped, number

Tails = tuple[bytes, ...]
"""The ends of a device's lines, each behind `name{labels`; the first is empty, so that these are what is between."""

_LINES_A_PART = 200
"""As many as there are of plain numbers with so many devices."""

_TAILS_KEPT = 64
"""Of a point's values that were written last; states are few, bits hardly ever change."""


@dataclass(frozen=True, slots=True)
class Shown:
    """The devices of one model that show values now, in order; the tuples are parallel."""

    labels: tuple[bytes, ...]  # without the braces
    closed: tuple[bytes, ...]  # the same with the closing brace
    values: tuple[Mapping[str, Value], ...]
    texts: tuple[Mapping[str, str], ...]


class NumberColumn:
    """A point whose value is one number."""

    __slots__ = ("_begin", "_name", "_pick", "_scale")

    def __init__(self, metric: str, name: str, scale: float) -> None:
        self._begin = f"{metric}{{".encode()
        self._name = name
        self._pick: Callable[[Mapping[str, Value]], Value] = itemgetter(name)
        self._scale = scale

    def parts(self, shown: Shown) -> Iterator[Sequence[bytes]]:
        """The lines of the devices that have a value, in pieces; at once."""
        labels: Sequence[bytes] = shown.closed
        try:
            values = list(map(self._pick, shown.values))
        except KeyError:
            having = [at for at, values in enumerate(shown.values) if self._name in values]
            labels = [labels[at] for at in having]
            values = [shown.values[at][self._name] for at in having]
        if self._scale != 1:
            scale = self._scale
            values = [value * scale for value in values]
        pieces = [self._begin] * (3 * len(values))
        pieces[1::3] = labels
        pieces[2::3] = map(number, values)
        yield pieces


class TailsColumn:
    """A point of which each device has several lines, by its value."""

    __slots__ = ("_begin", "_kept", "_name", "_of_texts", "_tails")

    def __init__(
        self, metric: str, name: str, tails: Callable[[Value | str], Tails], *, of_texts: bool = False
    ) -> None:
        """`tails` are those of a value; called when they are not kept."""
        self._begin = f"{metric}{{".encode()
        self._name = name
        self._tails = tails
        self._of_texts = of_texts
        self._kept: dict[Value | str, Tails] = {}

    def parts(self, shown: Shown) -> Iterator[Sequence[bytes]]:
        """The lines of the devices that have a value, in pieces; a few devices at a time: there may be many lines."""
        begin, name, kept = self._begin, self._name, self._kept
        values: Sequence[Mapping[str, Value | str]] = shown.texts if self._of_texts else shown.values
        pieces: list[bytes] = []
        lines = 0
        for labels, of in zip(shown.labels, values, strict=True):
            if name in of:
                value = of[name]
                tails = kept[value] if value in kept else self._keep(value)
                pieces.append((begin + labels).join(tails))
                lines += len(tails)
                if lines > _LINES_A_PART:
                    yield pieces
                    pieces, lines = [], 0
        yield pieces

    def _keep(self, value: Value | str) -> Tails:
        if len(self._kept) >= _TAILS_KEPT:
            self._kept.clear()
        self._kept[value] = tails = self._tails(value)
        return tails


Column = NumberColumn | TailsColumn


def column_of(model: DeviceMap, point: Point, metric: str) -> Column:
    """How a point of a model is written."""
    if point.enumeration is not None:
        entries = model.enumerations[point.enumeration]
        return TailsColumn(metric, point.name, _one_of({entry.number: entry.name for entry in entries}))
    if point.bits is not None:
        return TailsColumn(metric, point.name, _bits({bit.number: bit.name for bit in model.bit_tables[point.bits]}))
    if point.kind is Kind.TEXT:
        return TailsColumn(metric, point.name, lambda value: _text(point.name, str(value)), of_texts=True)
    return NumberColumn(metric, point.name, point.metric_scale)


def states(label: str, names: Mapping[str, bool]) -> Tails:
    """A line for each name, 1 where it holds."""
    return (b"", *(f',{label}="{escaped(name)}"}} {holds:d}.0\n'.encode() for name, holds in names.items()))


def _one_of(names: Mapping[int, str]) -> Callable[[Value | str], Tails]:
    def tails(value: Value | str) -> Tails:
        found = {name: code == value for code, name in names.items()}
        if value not in names:
            found[f"value_{int(value)}"] = True
        return states("state", found)

    return tails


def _bits(names: Mapping[int, str]) -> Callable[[Value | str], Tails]:
    def tails(value: Value | str) -> Tails:
        bits = int(value)
        found = {name: bool(bits >> bit & 1) for bit, name in names.items()}
        unnamed = (bit for bit in range(bits.bit_length()) if bits >> bit & 1 and bit not in names)
        return states("bit", found | {f"bit_{bit}": True for bit in unnamed})

    return tails


def _text(label: str, value: str) -> Tails:
    return (b"", f',{label}="{escaped(value)}"}} 1.0\n'.encode())
