"""How often a register may be written: the memory behind it lasts only so many writes.

Rule 1: a point that wears is written at most `per_day` times within any 24 hours, each controller and register apart;
        over it exception 06. Writes that may have been taken count like those that were.
Rule 2: any register or coil is written at most every `interval_s`; sooner is 06. Slave control is not looked at here.
Rule 3: the times are monotonic. What earlier runs wrote is told at start by its age; a wall clock that was wrong
        then can only make an age zero, never less, so that it cannot lock a register for longer than a day.
"""

from __future__ import annotations

from dataclasses import dataclass

from gateway.devices.model import Space
from gateway.errors import WriteBudgetSpent, WriteTooSoon

DAY_S = 86_400.0

Cell = tuple[int, Space, int]
"""Unit id, space, address."""


@dataclass(frozen=True, slots=True)
class WearLimits:
    """How often is too often."""

    per_day: int = 10
    interval_s: float = 1.0


class Wear:
    """The last writes of every register and coil."""

    def __init__(self, limits: WearLimits) -> None:
        self._limits = limits
        self._last: dict[Cell, float] = {}
        self._worn: dict[Cell, list[float]] = {}  # the last `per_day` writes, oldest first

    def limit(self, limits: WearLimits) -> None:
        """Other limits from now on; what was written before counts."""
        self._limits = limits

    def check(self, cell: Cell, now: float, *, wears: bool) -> None:
        """Raise WriteTooSoon or WriteBudgetSpent when a write at `now` would be one too many."""
        last = self._last.get(cell)
        if last is not None and now - last < self._limits.interval_s:
            raise WriteTooSoon(f"0x{cell[2]:04X} was written {now - last:.1f} s ago")
        if wears and self.left(cell, now) <= 0:
            raise WriteBudgetSpent(f"0x{cell[2]:04X} was written {self._limits.per_day} times within a day")

    def left(self, cell: Cell, now: float) -> int:
        """How many more writes of a register that wears are allowed at `now`."""
        return self._limits.per_day - sum(now - at < DAY_S for at in self._worn.get(cell, ()))

    def spend(self, cell: Cell, now: float, *, wears: bool) -> None:
        """A write goes out."""
        self._last[cell] = now
        if wears:
            self._spent(cell, now)

    def take_back(self, cell: Cell, *, wears: bool) -> None:
        """The write that was spent last did not go out after all."""
        self._last.pop(cell, None)
        if wears:
            self._worn[cell].pop()

    def restore(self, cell: Cell, age_s: float, now: float) -> None:
        """A write of an earlier run, `age_s` ago by the wall clock."""
        self._spent(cell, now - max(0.0, age_s))

    def _spent(self, cell: Cell, at: float) -> None:
        self._worn[cell] = sorted((*self._worn.get(cell, ()), at))[-self._limits.per_day :]
