"""What one device may still answer late, and what it must answer before it is asked on.

An RTU reply names neither its request nor the registers: function and size are all that ties them together. So a
reply that did not come in time, not even after the quarantine, would fit the next request of the same shape, seconds
later, with another register's value. No waiting rules that out; an order does:

Rule 1: a device answers in the order in which it was asked. An answer settles all that was asked before it.
Rule 2: a request that ended without a good reply leaves its function in doubt. Lengths do not tell two requests of
        one function apart, for an exception fits both.
Rule 3: no request goes out whose function is in doubt, not even the same one again. The device is first asked
        something small with a function that is not: its answer can be nothing else, and settles the rest (rule 1).
Rule 4: when every function is in doubt, the small question takes the one that has been so for the shortest time. Its
        answer settles what is older than that function's first unanswered request; the function itself stays in doubt.
Rule 5: neither time nor a port that was opened again settles anything.
"""

from __future__ import annotations

from collections.abc import Sequence


class Doubt:
    """The functions of one device that may still be answered late."""

    __slots__ = ("_asked", "_open")

    def __init__(self) -> None:
        self._asked = 0
        self._open: dict[int, tuple[int, int]] = {}  # function → its first and last unanswered request

    def allows(self, function: int) -> bool:
        """Whether a request of that function can only be answered by its own reply."""
        return function not in self._open

    def missed(self, function: int) -> None:
        """A request ended without a good reply."""
        self._asked += 1
        first, _ = self._open.get(function, (self._asked, 0))
        self._open[function] = (first, self._asked)

    def answered(self, function: int) -> None:
        """A request was answered, or so it seems when its function was in doubt (rule 4)."""
        if function not in self._open:
            self._open.clear()
            return
        since, _ = self._open[function]
        self.missed(function)  # the answer may be an older one's, and this one's still to come
        for other, (first, last) in list(self._open.items()):
            if last < since:
                del self._open[other]
            else:
                self._open[other] = (max(first, since), last)

    def choose(self, functions: Sequence[int]) -> int:
        """Of the functions that a device knows, the one for the small question of rules 3 and 4."""
        free = next((function for function in functions if function not in self._open), None)
        return max(functions, key=lambda function: self._open[function][0]) if free is None else free
