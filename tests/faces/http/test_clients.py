"""Who asks: as metrics and for programs."""

from __future__ import annotations

import aiohttp

from gateway.clock import Clock
from gateway.core.clients import Client, ClientTable
from gateway.core.ratelimit import ClientRate
from gateway.core.site import Site
from gateway.core.stats import ModbusServerStats
from gateway.faces.http.app import HttpFace
from gateway.faces.http.clients import clients_document
from gateway.faces.http.exposition import Exposition
from gateway.faces.http.own import Counts
from gateway.faces.http.settings import HttpSettings
from tests.faces.http.scrapes import parse, scrape

from .conftest import ManualClock

RATE = ClientRate(requests_per_s=0.0)


def asked(table: ClientTable, name: str, clock: Clock, *, hot: int, forwarded: int, refused: int) -> Client:
    """A client that had `hot` answers from memory, `forwarded` from the line and `refused` exceptions 0A."""
    now = clock.monotonic()
    client = table.arrived(name, RATE, now)
    client.lease(now)
    client.left -= hot + forwarded + refused
    client.slow += forwarded + refused
    client.forwarded += forwarded
    client.refused += refused
    if refused:
        client.exceptions[0x0A] += refused
    return client


def make_clients(clock: ManualClock) -> ClientTable:
    table = ClientTable(ModbusServerStats(), burst_s=2.0)
    asked(table, "192.0.2.1", clock, hot=90, forwarded=7, refused=3)
    gone = asked(table, "2001:db8::1", clock, hot=1, forwarded=0, refused=0)
    table.left(gone, clock.now)
    clock.now += 30.0
    table.arrived("192.0.2.1", RATE, clock.now)
    return table


def test_each_client_has_its_series(site: Site, clock: ManualClock) -> None:
    table = make_clients(clock)
    found = {
        (sample.name.removeprefix("prostar_gateway_modbus_client_"), *sample.labels.values()): sample.value
        for family in parse(scrape(Exposition(site, clock, Counts(clients=table))))
        for sample in family.samples
        if "client" in sample.labels
    }
    assert found == {
        ("connections", "192.0.2.1"): 2,
        ("connections", "2001:db8::1"): 0,
        ("idle_seconds", "192.0.2.1"): 0,
        ("idle_seconds", "2001:db8::1"): 30,
        ("connections_accepted_total", "192.0.2.1"): 2,
        ("connections_accepted_total", "2001:db8::1"): 1,
        ("requests_total", "192.0.2.1"): 100,
        ("requests_total", "2001:db8::1"): 1,
        ("cache_hits_total", "192.0.2.1"): 90,
        ("cache_hits_total", "2001:db8::1"): 1,
        ("forwarded_total", "192.0.2.1"): 7,
        ("forwarded_total", "2001:db8::1"): 0,
        ("rate_limited_total", "192.0.2.1"): 0,
        ("rate_limited_total", "2001:db8::1"): 0,
        ("exceptions_total", "192.0.2.1", "0A"): 3,
    }


def test_the_document_begins_with_who_asked_last(clock: ManualClock) -> None:
    table = make_clients(clock)
    clock.now += 1.24
    assert clients_document(table, clock.now) == {
        "clients": [
            {
                "client": "192.0.2.1",
                "connections": 2,
                "connections_total": 2,
                "first_seen_s_ago": 31.2,
                "last_seen_s_ago": 1.2,
                "requests": 100,
                "cache_hits": 90,
                "forwarded": 7,
                "rate_limited": 0,
                "exceptions": {"0A": 3},
            },
            {
                "client": "2001:db8::1",
                "connections": 0,
                "connections_total": 1,
                "first_seen_s_ago": 31.2,
                "last_seen_s_ago": 31.2,
                "requests": 1,
                "cache_hits": 1,
                "forwarded": 0,
                "rate_limited": 0,
                "exceptions": {},
            },
        ]
    }


async def test_it_is_served(site: Site, clock: ManualClock) -> None:
    face = HttpFace(
        HttpSettings(listen=(("127.0.0.1", 0),)),
        site,
        clock,
        modbus=ModbusServerStats(),
        snmp=dict,
        not_ready=list,
        clients=make_clients(clock),
    )
    listener = face.listeners[0]
    await listener.start()
    assert listener.bound is not None
    host, port = listener.bound
    try:
        async with aiohttp.ClientSession() as session, session.get(f"http://{host}:{port}/api/v1/clients") as reply:
            assert reply.status == 200
            assert reply.headers["Cache-Control"] == "no-store"
            assert [client["client"] for client in (await reply.json())["clients"]] == ["192.0.2.1", "2001:db8::1"]
    finally:
        await listener.stop()
