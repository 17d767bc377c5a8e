"""What the supervisor keeps going: the shape of a line, a keeper, a listener."""

from __future__ import annotations

from typing import Protocol


class Runnable(Protocol):
    """Work that goes on until it is cancelled, and opens and reopens what it needs by itself."""

    @property
    def name(self) -> str:
        """What the log calls its task; of a line the configured name."""
        ...

    async def run(self) -> None:
        """Work until cancelled."""
        ...


class Line(Runnable, Protocol):
    """A line: other parts ask it, so it stops after them, and in order."""

    def overdue_s(self, now: float) -> float:
        """How long it has had something to do and has not done it; 0 while it waits for its port."""
        ...

    async def finish(self) -> None:
        """Begin nothing more, answer 06 to what waits, return when nothing is on the wire. `run` goes on."""
        ...


class Listener(Protocol):
    """One address of a face."""

    @property
    def label(self) -> str:
        """Face and address, such as "modbus 127.0.0.1:1502"."""
        ...

    @property
    def bound(self) -> tuple[str, int] | None:
        """The real address while it listens."""
        ...

    async def start(self) -> None:
        """Open the address; ListenError when it cannot be opened. May be tried again."""
        ...

    async def stop(self) -> None:
        """Close it and what came in by it."""
        ...
