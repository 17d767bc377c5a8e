"""Who asked, how often, and what of it was answered from memory."""

from __future__ import annotations

from gateway.core.clients import LEASE, REMEMBERED, Client, ClientTable
from gateway.core.ratelimit import ClientRate
from gateway.core.stats import ModbusServerStats

RATE = ClientRate(requests_per_s=1000.0)
FREE = ClientRate(requests_per_s=0.0)


def hot(client: Client, count: int, now: float = 0.0) -> int:
    """Ask `count` times for what lies ready; returns how often there was a token."""
    done = 0
    for _ in range(count):
        if client.lease(now):
            client.left -= 1
            done += 1
    return done


def test_what_was_granted_and_is_not_left_was_asked() -> None:
    stats = ModbusServerStats()
    table = ClientTable(stats, burst_s=2.0)
    client = table.arrived("192.0.2.1", RATE, 0.0)
    assert hot(client, 3) == 3
    client.left -= 1
    client.slow += 1  # one that was not found ready and went to the line
    client.forwarded += 1
    assert (client.requests, client.cache_hits) == (4, 3)
    for _ in range(2):  # settling twice counts once
        table.settle()
        assert (stats.requests, stats.cache_hits) == (3, 3)


def test_a_client_has_its_rate_and_no_more() -> None:
    client = ClientTable(ModbusServerStats(), burst_s=2.0).arrived("192.0.2.1", RATE, 0.0)
    assert hot(client, 5000) == 2000
    assert hot(client, 5000, now=1.0) == 1000


def test_without_a_limit_one_lease_is_enough() -> None:
    client = ClientTable(ModbusServerStats(), burst_s=2.0).arrived("127.0.0.1", FREE, 0.0)
    assert hot(client, 100_000) == 100_000
    assert client.requests == 100_000


def test_connecting_again_gives_no_new_tokens() -> None:
    table = ClientTable(ModbusServerStats(), burst_s=2.0)
    client = table.arrived("192.0.2.1", RATE, 0.0)
    assert hot(client, 2000) == 2000
    table.left(client, 0.5)
    again = table.arrived("192.0.2.1", RATE, 0.5)
    assert again is client
    assert hot(again, 2000, now=0.5) == 500
    assert (again.connections, again.open_connections) == (2, 1)


def test_who_is_gone_is_forgotten_when_there_are_many_and_its_counts_are_not() -> None:
    stats = ModbusServerStats()
    table = ClientTable(stats, burst_s=2.0)
    here = table.arrived("192.0.2.1", RATE, 0.0)
    for number in range(3 * REMEMBERED):
        client = table.arrived(f"10.0.{number // 256}.{number % 256}", RATE, float(number))
        hot(client, 2, now=float(number))
        table.left(client, float(number))
    assert len(table) <= REMEMBERED + 2
    assert here in set(table)
    table.settle()
    assert stats.requests == 6 * REMEMBERED
    assert "10.0.0.0" not in {client.name for client in table}


def test_the_one_who_left_last_is_remembered_longest() -> None:
    table = ClientTable(ModbusServerStats(), burst_s=2.0)
    first = table.arrived("192.0.2.1", RATE, 0.0)
    for number in range(REMEMBERED - 1):
        table.left(table.arrived(f"10.0.0.{number}", RATE, 1.0), 1.0)
    table.left(first, 2.0)
    for number in range(10):
        table.left(table.arrived(f"10.0.1.{number}", RATE, 3.0), 3.0)
    names = {client.name for client in table}
    assert "192.0.2.1" in names
    assert "10.0.0.0" not in names


def test_a_lease_is_small_against_a_burst() -> None:
    assert RATE.requests_per_s * 0.5 > LEASE


def test_another_rate_begins_with_full_buckets_and_keeps_the_counts() -> None:
    table = ClientTable(ModbusServerStats(), burst_s=1.0)
    client = table.arrived("192.0.2.1", ClientRate(requests_per_s=100.0), 0.0)
    assert hot(client, 150) == 100
    asked = client.requests
    table.limit(lambda _name: ClientRate(requests_per_s=30.0), 2.0, 0.0)
    assert client.requests == asked
    assert hot(client, 150) == 60
    table.limit(lambda _name: FREE, 2.0, 0.0)
    assert hot(client, 5000) == 5000
    assert client.requests == asked + 60 + 5000
    assert hot(table.arrived("192.0.2.2", FREE, 0.0), 5000) == 5000
