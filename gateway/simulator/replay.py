"""A line that answers as it did when it was recorded.

Rule 1: a request is answered with the bytes that followed the same request in the recording, after the same time:
        late replies, noise and silence are repeated as they were.
Rule 2: what was asked several times is answered in the order of the recording, then from the beginning again.
Rule 3: what was never asked is not answered, and counted.
"""

from __future__ import annotations

import heapq
from collections import deque
from dataclasses import dataclass

from gateway.modbus.crc import crc_ok
from gateway.modbus.recording import Recording
from gateway.simulator.line import SimulatedLine

_LONGEST_REQUEST = 256


@dataclass(frozen=True, slots=True)
class Answer:
    """What followed a request: pieces, each with its delay after the request in seconds."""

    pieces: tuple[tuple[float, bytes], ...]


class ReplayedLine(SimulatedLine):
    """The far end of a recorded line."""

    def __init__(self, recording: Recording) -> None:
        super().__init__([])
        self.unknown = 0  # requests that are not in the recording
        self.answered = 0
        self._answers = answers_of(recording)
        self._asked = b""
        self._on_the_way: list[tuple[float, int, bytes]] = []
        self._count = 0

    @property
    def requests(self) -> int:
        """How many different requests it knows."""
        return len(self._answers)

    def receive(self, data: bytes, now: float) -> None:
        """Bytes of a request came in."""
        self._asked = (self._asked + data)[-_LONGEST_REQUEST:]
        known = self._answers.get(self._asked)
        if known is None and not crc_ok(self._asked):
            return  # the rest of it is still to come
        self._asked = b""
        if known is None:
            self.unknown += 1
            return
        answer = known[0]
        known.rotate(-1)
        self.answered += 1
        for delay_s, piece in answer.pieces:
            self._count += 1
            heapq.heappush(self._on_the_way, (now + delay_s, self._count, piece))

    def next_event(self) -> float | None:
        """When the next piece arrives."""
        return self._on_the_way[0][0] if self._on_the_way else None

    def take(self, now: float) -> bytes:
        """What arrived by now."""
        arrived = b""
        while self._on_the_way and self._on_the_way[0][0] <= now:
            arrived += heapq.heappop(self._on_the_way)[2]
        return arrived

    def clear(self) -> None:
        """Forget what is on its way."""
        self._asked = b""
        self._on_the_way.clear()


def answers_of(recording: Recording) -> dict[bytes, deque[Answer]]:
    """The answers to each request, in their order; what came before the first request is left out."""
    answers: dict[bytes, deque[Answer]] = {}
    request, asked_at = b"", 0.0
    pieces: list[tuple[float, bytes]] = []
    for piece in (*(piece for piece in recording.pieces if piece.data), None):
        if piece is not None and not piece.sent:
            pieces.append((piece.at_s - asked_at, piece.data))
            continue
        if request:
            answers.setdefault(request, deque()).append(Answer(tuple(pieces)))
        if piece is not None:
            request, asked_at, pieces = piece.data, piece.at_s, []
    return answers
