"""What came of requests, until those who asked are told.

Rule 1: outcomes are handed out in the order in which they came to be, each waiter's once (requests.py), and only when
        the engine says so: never from within the call that brought them.
Rule 2: what an asker does with its outcome is its own affair. A mistake there is logged, and stops neither the others
        nor the line.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Iterable

from gateway.core.requests import Waiter
from gateway.core.site import Outcome

log = logging.getLogger(__name__)


class Outcomes:
    """Those of one line; true while somebody is to be told."""

    def __init__(self, line: str) -> None:
        self._line = line
        self._due: deque[tuple[Waiter, Outcome]] = deque()

    def __bool__(self) -> bool:
        return bool(self._due)

    def add(self, waiters: Iterable[Waiter], outcome: Outcome) -> None:
        """These are to be told this."""
        for waiter in waiters:
            self._due.append((waiter, outcome))

    def hand_out(self) -> None:
        """Tell everybody, those too who are added meanwhile."""
        while self._due:
            waiter, outcome = self._due.popleft()
            try:
                waiter.finish(outcome)
            except Exception:  # the edge to a face: its mistake must not stop the line
                log.exception("event=outcome_handler_failed line=%s", self._line)
