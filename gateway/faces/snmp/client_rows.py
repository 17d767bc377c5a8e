"""Which Modbus TCP client is in which row of the client table.

Rows are bounded and a client keeps its row as long as it is known and nobody newer needs one: first the free rows are
given away, then those of clients without a connection, the longest gone first.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

from gateway.core.clients import Client

MOST_ROWS = 64
REFRESH_S = 1.0


class ClientRows:
    """The rows; `clients` are those of the Modbus TCP face at any moment."""

    def __init__(self, clients: Iterable[Client] = ()) -> None:
        self._clients = clients
        self._rows: dict[int, Client] = {}
        self._due = -math.inf
        self._present: list[int] = []

    def at(self, number: int, now: float) -> Client | None:
        """The client in a row, None when there is none."""
        self._look(now)
        return self._rows.get(number)

    def present(self, now: float) -> list[int]:
        """The rows that somebody is in, in their order."""
        self._look(now)
        return self._present

    def _look(self, now: float) -> None:
        if now >= self._due:
            self._due = now + REFRESH_S
            self._give_away(sorted(self._clients, key=lambda client: -client.last_seen))
            self._present = sorted(self._rows)

    def _give_away(self, clients: list[Client]) -> None:
        """`clients` are those that are known, the last seen first."""
        known = set(clients)
        rows = {number: client for number, client in self._rows.items() if client in known}
        seated = set(rows.values())
        free = [number for number in range(1, MOST_ROWS + 1) if number not in rows]
        for client in clients:
            if client in seated:
                continue
            if not free:
                idle = [number for number, other in rows.items() if not other.open_connections]
                longest = min(idle, key=lambda number: rows[number].last_seen, default=None)
                if longest is None or rows[longest].last_seen >= client.last_seen:
                    break
                free = [longest]
            rows[free.pop(0)] = client
        self._rows = rows
