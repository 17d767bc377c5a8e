"""Turns that come before anything that the scheduler has.

Rule 1: a turn whose device must first answer the question that settles its missed replies (doubt.py) is held. It goes
        on when that was answered, if it is still wanted; a poll that was not begun is let go instead, for it is due
        still.
Rule 2: turns that ended through no fault of their own are made again, once, before anything else. The first of them
        has the line to itself: nothing else begins before it has ended. So a server that does not stand company is
        found out, and when it is one device's silence that took the others with it, that shows too.
"""

from __future__ import annotations

from collections import deque

from gateway.core.requests import PollItem, Purpose, ReadTurn, Turn, WriteTurn
from gateway.core.turns import is_wanted
from gateway.core.under_way import UnderWay


class SetAside:
    """Held turns and those to be made again, of one line."""

    def __init__(self, under_way: UnderWay) -> None:
        self._under_way = under_way
        self._held: dict[int, Turn] = {}  # by unit id
        self._again: deque[Turn] = deque()
        self._alone: Turn | None = None  # the first of them

    def is_alone(self, turn: Turn) -> bool:
        """Whether the line must be its own (rule 2)."""
        return turn is self._alone

    def blocks(self) -> bool:
        """Whether nothing may begin now: rule 2."""
        return self._under_way.alone or (self._alone is not None and bool(self._under_way))

    def due(self) -> bool:
        """Whether there is something that could begin now."""
        return bool(self._again) or any(self._under_way.idle(turn.device) for turn in self._held.values())

    def first(self) -> Turn | None:
        """The turn to make next, or None; one that was held is not held any more."""
        for unit, turn in list(self._held.items()):
            if self._under_way.idle(turn.device):
                del self._held[unit]
                if is_wanted(turn):
                    return turn
                self.forget(turn)
        while self._again:
            if is_wanted(self._again[0]):
                return self._again[0]
            self.forget(self._again[0])
        return None

    def hold(self, turn: Turn) -> None:
        """A question goes out in its place (rule 1)."""
        self._held[turn.device.unit_id] = turn

    def settled(self, turn: Turn) -> None:
        """The question of that turn's device was answered."""
        held = self._held.get(turn.device.unit_id)
        if isinstance(held, PollItem) and not held.again:
            self.forget(held)

    def unsettled(self, turn: Turn) -> Turn | None:
        """It was not: the turn that fails with it, None when all were cleared meanwhile."""
        held = self._held.get(turn.device.unit_id)
        if held is not None:
            self.forget(held)
        return held

    def again(self, turn: Turn) -> bool:
        """Whether it is made again (rule 2); a write never is, and nothing twice."""
        if turn.purpose is Purpose.SETTLE:
            held = self._held.get(turn.device.unit_id)
            if held is None or isinstance(held, WriteTurn) or held.again:
                return False
            held.again = True  # it stays held, so the question is asked again
            return True
        if isinstance(turn, WriteTurn) or turn.again:
            return False
        turn.again = True
        if not self._again:
            self._alone = turn
        self._again.append(turn)
        if isinstance(turn, ReadTurn):
            for read in turn.reads:
                read.attempts -= 1
        return True

    def begun(self, turn: Turn) -> None:
        """It went out."""
        if turn in self._again:
            self._again.remove(turn)
        if turn is self._alone:
            self._alone = None

    def forget(self, turn: Turn) -> None:
        """It has ended, or nobody wants it any more; a poll will be made again as if for the first time."""
        self.begun(turn)
        if self._held.get(turn.device.unit_id) is turn:
            del self._held[turn.device.unit_id]
        if not isinstance(turn, WriteTurn):
            turn.again = False

    def clear(self) -> list[Turn]:
        """All have ended."""
        turns = [*self._held.values(), *(turn for turn in self._again if turn not in self._held.values())]
        for turn in turns:
            self.forget(turn)
        return turns
