"""What the wire does to frames; the place where chaos sits.

A medium sees every whole request before the stations do and every whole reply before it is paced.
It answers with the bytes that go on; nothing else of the line knows that bytes can be lost. The clean
medium changes nothing. Times are the line's (seconds, monotonic or virtual).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol


@dataclass(frozen=True, slots=True)
class Burst:
    """Bytes for the client that start at `at`, or as soon after it as the wire is free.

    `whole`: the client's adapter keeps them back until the last one is there.
    """

    at: float
    data: bytes
    whole: bool = False


class Medium(Protocol):
    """What happens to a frame between the client and the stations."""

    def request(self, frame: bytes, ended_at: float) -> bytes:
        """The bytes that the stations hear of a request; empty when it is lost."""
        ...

    def echo(self, frame: bytes, started_at: float) -> Sequence[Burst]:
        """The bytes of its own request (or noise after it) that the client hears; usually none."""
        ...

    def reply(self, frame: bytes, starts_at: float) -> Sequence[Burst]:
        """The bytes that the client hears of a reply; none when it is lost."""
        ...


class CleanMedium:
    """A wire that changes nothing."""

    def request(self, frame: bytes, ended_at: float) -> bytes:
        """See `Medium.request`."""
        del ended_at
        return frame

    def echo(self, frame: bytes, started_at: float) -> Sequence[Burst]:
        """See `Medium.echo`."""
        del frame, started_at
        return ()

    def reply(self, frame: bytes, starts_at: float) -> Sequence[Burst]:
        """See `Medium.reply`."""
        return (Burst(starts_at, frame),)
