"""What a Modbus TCP server does with its connections, as learnt from them.

Namely for how many requests each is good, and whether anybody answers at all.

Rule 1: a server is taken for one that closes after every reply when it closed two connections with one reply each. As
        long as it is not known to keep them, nothing goes out into a connection for 50 ms after its first reply, so
        that no request is lost in one that is being closed.
Rule 2: then a connection is good for one request: after its reply nothing goes out into it, and we end it ourselves if
        the other end has not done so within 50 ms. Every ten minutes one is used on, to see whether that still holds.
Rule 3: a server is `silent` when three connections in a row ended by a time-out without a single reply, and requests
        to more than one unit were among them. Then it stays so from one connection to the next until it answers.
"""

from __future__ import annotations

import math

ONE_REPLY_TIMES = 2
CLOSES_WITHIN_S = 0.05
LOOK_AGAIN_S = 600.0
SILENT_TIMES = 3


class Habits:
    """The habits of one server."""

    __slots__ = ("_look_again_at", "_one_reply", "_silent", "_silent_at", "_unheard", "keeps")

    def __init__(self) -> None:
        self.keeps = False  # it answered twice on one connection, and has closed none after one reply since
        self._one_reply = 0  # connections in a row that the other end closed after one reply
        self._look_again_at = -math.inf
        self._silent = 0  # connections in a row that a time-out ended and nothing was heard on
        self._silent_at = -math.inf  # when the last of them ended
        self._unheard: set[int] = set()  # the units that were asked on them and timed out

    @property
    def silent(self) -> bool:
        """Whether the server says nothing to anybody (rule 3)."""
        return self._silent >= SILENT_TIMES and len(self._unheard) > 1

    def single_use(self, now: float) -> bool:
        """Whether a connection is good for one request (rule 2)."""
        return self._one_reply >= ONE_REPLY_TIMES and now < self._look_again_at

    def answered(self, replies: int) -> None:
        """A reply came; `replies`: how many did on its connection, this one included."""
        self._silent = 0
        self._unheard.clear()
        if replies > 1:
            self._one_reply = 0
            self.keeps = True

    def unanswered(self, unit: int) -> None:
        """A request to that unit timed out."""
        self._unheard.add(unit)

    def closed(self, replies: int, now: float) -> None:
        """The other end closed or reset a connection with so many replies on it."""
        if replies == 1:
            if self._one_reply >= ONE_REPLY_TIMES - 1:
                self._look_again_at = now + LOOK_AGAIN_S
            self._one_reply += 1
            self.keeps = False
        elif replies > 1:
            self._one_reply = 0

    def heard_nothing(self, asked_at: float, now: float) -> None:
        """A time-out ended a connection without a reply; those that were asked together count once."""
        if asked_at >= self._silent_at:
            self._silent += 1
            self._silent_at = now
