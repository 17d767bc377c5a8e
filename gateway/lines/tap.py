"""Who watches the bytes of a line: nobody, as a rule, and that costs nothing."""

from __future__ import annotations

from collections.abc import Callable

Watcher = Callable[[float, bool, bytes, int], None]
"""Is told when (monotonic), whether it was sent, the bytes, and on which of an upstream's connections.

No bytes mean that whoever would have sent them closed the connection. It must not block and must not raise.
"""


class Tap:
    """The watchers of one line."""

    def __init__(self) -> None:
        self._watchers: tuple[Watcher, ...] = ()

    def __bool__(self) -> bool:
        """Whether anybody watches."""
        return bool(self._watchers)

    def open(self, watcher: Watcher) -> None:
        """Tell this one too from now on."""
        self._watchers += (watcher,)

    def close(self, watcher: Watcher) -> None:
        """Tell it no more."""
        self._watchers = tuple(one for one in self._watchers if one is not watcher)

    def tell(self, now: float, *, sent: bool, data: bytes, connection: int = 0) -> None:
        """Bytes went out, or came in."""
        for watcher in self._watchers:
            watcher(now, sent, data, connection)
