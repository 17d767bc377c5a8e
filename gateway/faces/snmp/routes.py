"""The short ways to cells whose values are numbers of points.

The tail of a request (`singles.py`) is a frame, the column's prefix, the row's index and NULL. Rules:

1. A way leads from frame and prefix to what is the same in the whole column, and from index and NULL to the device of
   the row and the octets of its index. All of it follows from what the tree is made of, which never changes.
2. For GETNEXT it leads to the next row of the same column. Where that has an index of another length, or there is none,
   there is no way.
3. Ways are learned for columns that there are, so there are at most two for a column, kind of request and length of an
   index; rows are shared by all columns that have the same ones. A way takes about 350 octets, a row of them 200.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence

from gateway.core.site import Device
from gateway.devices.model import Value
from gateway.faces.snmp.columns import Column
from gateway.faces.snmp.rows import Rows

Targets = Mapping[bytes, tuple[Device, bytes]]
"""By index and NULL of a request: the device of the row that is to be shown, and its index."""

Route = tuple[Targets, str, Mapping[Value, bytes], bytes]
"""The rows, the point, the octets of its values, and the encoded name up to the index."""

_NULL = b"\x05\x00"


class Routes:
    """The ways of one window."""

    def __init__(self, columns: Sequence[Column]) -> None:
        sizes = Counter(len(column.prefix) for column in columns if column.object.encodings is not None)
        self.prefix_size = max(sizes, key=sizes.__getitem__, default=0)  # of all columns that can have a way
        self._known: dict[tuple[bytes, int], dict[bytes, Route]] = {}
        self._targets: dict[tuple[Rows, int, int], Targets] = {}

    def of(self, frame: bytes, ahead: int) -> dict[bytes, Route]:
        """The ways by frame and prefix, for requests with this frame for what is so many rows ahead."""
        return self._known.setdefault((frame, ahead), {})

    def learn(self, frame: bytes, ahead: int, column: Column, index_size: int) -> None:
        """Learn the way to a column, if there can be one, for indexes of so many octets."""
        described = column.object
        if described.encodings is None or described.point is None or len(column.prefix) != self.prefix_size:
            return
        targets = self._of_rows(column.rows, ahead, index_size)
        name = frame[-2:] + column.prefix
        self.of(frame, ahead)[frame + column.prefix] = targets, described.point, described.encodings, name

    def _of_rows(self, rows: Rows, ahead: int, index_size: int) -> Targets:
        key = rows, ahead, index_size
        known = self._targets.get(key)
        if known is None:
            known = self._targets[key] = dict(_targets(rows, ahead, index_size))
        return known


def _targets(rows: Rows, ahead: int, index_size: int) -> Iterator[tuple[bytes, tuple[Device, bytes]]]:
    for at in range(rows.size - ahead):
        suffix, shown, device = rows.suffix(at), rows.suffix(at + ahead), rows.device(at + ahead)
        if device is not None and len(suffix) == len(shown) == index_size:
            yield suffix + _NULL, (device, shown)
