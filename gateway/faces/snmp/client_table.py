"""The table of Modbus TCP clients.

Numbers are append-only (mibs/oids.lock); a new object takes the next free one.
"""

from __future__ import annotations

from collections.abc import Callable

from gateway.core.clients import Client
from gateway.faces.snmp.client_rows import MOST_ROWS
from gateway.faces.snmp.objects import CellValue, ClientRow, Index, ObjectType, Syntax, text

INDEX = Index(
    1,
    "pgwClientIndex",
    1,
    MOST_ROWS,
    "Number of the row. A client keeps its row while it is known and nobody who came later needs it.",
)


def _of(get: Callable[[Client, float], CellValue]) -> Callable[[ClientRow, float], CellValue]:
    def cell(row: ClientRow, now: float) -> CellValue:
        client = row.gateway.clients.at(row.number, now)
        return None if client is None else get(client, now)

    return cell


def _counter(number: int, name: str, description: str, get: Callable[[Client], int]) -> ObjectType:
    return ObjectType(number, name, Syntax.COUNTER32, description, _of(lambda client, _now: get(client)))


CLIENT: tuple[ObjectType, ...] = (
    ObjectType(
        2, "pgwClientAddress", Syntax.TEXT, "Address of the client.", _of(lambda client, _now: text(client.name))
    ),
    ObjectType(
        3,
        "pgwClientOpenConnections",
        Syntax.GAUGE32,
        "Its Modbus TCP connections that are open now.",
        _of(lambda client, _now: client.open_connections),
    ),
    ObjectType(
        4,
        "pgwClientIdle",
        Syntax.TIME_TICKS,
        "Time since it last asked or connected, to about a second.",
        _of(lambda client, now: min(2**32 - 1, max(0, int((now - client.last_seen) * 100)))),
    ),
    _counter(5, "pgwClientConnections", "Its connections that were let in.", lambda client: client.connections),
    _counter(6, "pgwClientRequests", "Its requests.", lambda client: client.requests),
    _counter(7, "pgwClientCacheHits", "Its requests answered from memory.", lambda client: client.cache_hits),
    _counter(8, "pgwClientForwarded", "Its requests that needed a line.", lambda client: client.forwarded),
    _counter(9, "pgwClientRateLimited", "Its requests refused for a rate limit.", lambda client: client.limited),
    _counter(
        10,
        "pgwClientExceptions",
        "Exception replies that it was given, of any code.",
        lambda client: client.exceptions.total(),
    ),
)
