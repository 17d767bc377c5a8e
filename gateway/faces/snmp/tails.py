"""Tables whose rows come and go: they lie behind the cells that a tree has once and for all.

A window holds its tails in the order of their bases. What they show is never kept in an answer: it can change without
the snapshot of a device.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Protocol

from gateway.faces.snmp.settings import Oid, View


class Tail(Protocol):
    """One such table."""

    @property
    def base(self) -> Oid:
        """The parent of its columns."""
        ...

    def get(self, oid: Oid, now: float) -> bytes | None:
        """The varbind of exactly this OID, or None."""
        ...

    def steps(self, oid: Oid, now: float) -> Iterator[tuple[bytes, bytes]]:
        """Each cell behind `oid`: its encoded name and its varbind."""
        ...

    def through(self, view: View) -> Tail:
        """What a view shows of it; itself when that is all."""
        ...


class Tails:
    """Some of them, in the order of a walk; ValueError when they are not."""

    def __init__(self, tails: Iterable[Tail]) -> None:
        self.tails = tuple(tails)
        bases = [tail.base for tail in self.tails]
        if bases != sorted(bases):
            raise ValueError(f"{bases} are not in the order of a walk")

    def get(self, oid: Oid, now: float) -> bytes | None:
        """See Tail."""
        for tail in self.tails:
            if oid[: len(tail.base)] == tail.base:
                return tail.get(oid, now)
        return None

    def steps(self, oid: Oid, now: float) -> Iterator[tuple[bytes, bytes]]:
        """See Tail."""
        for tail in self.tails:
            yield from tail.steps(oid, now)

    def through(self, view: View) -> Tails:
        """See Tail."""
        shown = [tail.through(view) for tail in self.tails]
        return self if all(map(lambda a, b: a is b, shown, self.tails)) else Tails(shown)


def shows_all(view: View, base: Oid) -> bool:
    """Whether a view shows everything below a node, whatever will be there."""
    return view.shows(base) and not any(each[: len(base)] == base for each in view.exclude)
