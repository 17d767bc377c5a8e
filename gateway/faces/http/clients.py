"""Who asks by Modbus TCP: metrics with the label `client`, and `/api/v1/clients` for people and programs.

The clients are those that core/clients.py remembers: all that are connected and the last 256 that were, so that
the number of series is bounded. One that is forgotten takes its series along.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from gateway.core.clients import Client
from gateway.faces.http.rules import Rule, Source, each, gateway_counter, gateway_gauge, one

PATH = "/api/v1/clients"
CLIENT_LABELS = ("client",)


@dataclass(frozen=True, slots=True)
class ClientView:
    """A client at the moment of a scrape (monotonic)."""

    client: Client
    now: float

    @property
    def idle_s(self) -> float:
        """Time since its last request, to about a second."""
        return max(0.0, self.now - self.client.last_seen)


CLIENT_RULES: tuple[Rule[ClientView], ...] = (
    one(
        gateway_gauge("modbus_client_connections", "Open Modbus TCP connections of a client address.", *CLIENT_LABELS),
        lambda view: view.client.open_connections,
    ),
    one(
        gateway_gauge("modbus_client_idle_seconds", "Time since its last request or connection.", *CLIENT_LABELS),
        lambda view: view.idle_s,
    ),
    one(
        gateway_counter("modbus_client_connections_accepted", "Its connections that were let in.", *CLIENT_LABELS),
        lambda view: view.client.connections,
    ),
    one(
        gateway_counter("modbus_client_requests", "Its requests.", *CLIENT_LABELS),
        lambda view: view.client.requests,
    ),
    one(
        gateway_counter("modbus_client_cache_hits", "Its requests answered from memory.", *CLIENT_LABELS),
        lambda view: view.client.cache_hits,
    ),
    one(
        gateway_counter("modbus_client_forwarded", "Its requests that needed a line (cache misses).", *CLIENT_LABELS),
        lambda view: view.client.forwarded,
    ),
    one(
        gateway_counter("modbus_client_rate_limited", "Its requests refused for a rate limit.", *CLIENT_LABELS),
        lambda view: view.client.limited,
    ),
    each(
        gateway_counter(
            "modbus_client_exceptions",
            "Exception replies it was given, by exception code (hexadecimal).",
            *CLIENT_LABELS,
            "code",
        ),
        lambda view: {f"{code:02X}": count for code, count in view.client.exceptions.items()},
    ),
)


def client_sources(clients: Iterable[Client], now: float) -> list[Source[ClientView]]:
    """The clients as sources of metrics."""
    return [Source.labelled(ClientView(client, now), CLIENT_LABELS, (client.name,)) for client in clients]


def clients_document(clients: Iterable[Client], now: float) -> dict[str, object]:
    """What `/api/v1/clients` says: who asked last comes first; times in seconds before now."""
    ordered = sorted(clients, key=lambda client: (-client.last_seen, client.name))
    return {
        "clients": [
            {
                "client": client.name,
                "connections": client.open_connections,
                "connections_total": client.connections,
                "first_seen_s_ago": round(max(0.0, now - client.first_seen), 1),
                "last_seen_s_ago": round(max(0.0, now - client.last_seen), 1),
                "requests": client.requests,
                "cache_hits": client.cache_hits,
                "forwarded": client.forwarded,
                "rate_limited": client.limited,
                "exceptions": {f"{code:02X}": count for code, count in sorted(client.exceptions.items())},
            }
            for client in ordered
        ]
    }
