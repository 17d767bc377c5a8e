"""What is wrong now, as metrics and as a document."""

from __future__ import annotations

import json

import aiohttp
import pytest

from gateway.core.conditions import HISTORY_DOWN, NOT_READY, Conditions
from gateway.core.site import Site
from gateway.core.stats import ModbusServerStats, NotifyStats
from gateway.faces.http.app import HttpFace
from gateway.faces.http.conditions import (
    DEVICE_CONDITION_RULES,
    GATEWAY_CONDITION_RULES,
    NOTIFY_RULES,
    WATCHES_A_PIECE,
    conditions_pieces,
    gateway_sources,
    receiver_source,
    wants_all,
)
from gateway.faces.http.rules import Source, families
from gateway.faces.http.settings import HttpSettings
from tests.core.test_conditions import BITS, Plant

from .conftest import ManualClock


def plant() -> Plant:
    made = Plant((HISTORY_DOWN, NOT_READY))
    made.shows(array_faults=1 << 3, alarms=1)
    made.conditions.gateway.tell(HISTORY_DOWN, raised=True, now=made.now)
    made.wait(9.0)
    return made


def lines(rules: object, sources: object) -> list[str]:
    return [line.decode().strip() for _, found in families(rules, sources) for line in found]  # type: ignore[arg-type]


def test_raised_conditions_of_a_device_are_counted_by_severity() -> None:
    of = plant().conditions.devices[7]
    assert lines(DEVICE_CONDITION_RULES, [Source(of, ("d",), b'device="d"')]) == [
        'prostar_gateway_conditions{device="d",severity="critical"} 1.0',
        'prostar_gateway_conditions{device="d",severity="info"} 0.0',
        'prostar_gateway_conditions{device="d",severity="warning"} 1.0',
    ]


def test_conditions_of_the_gateway_are_series_once_they_are_known() -> None:
    assert lines(GATEWAY_CONDITION_RULES, gateway_sources(plant().conditions)) == [
        'prostar_gateway_condition{condition="history_store_down",line=""} 1.0',
        'prostar_gateway_condition{condition="line_down",line="a"} 0.0',
    ]


def test_what_was_sent_is_counted_by_receiver() -> None:
    stats = NotifyStats("192.0.2.7:162", "inform", notifications=5, sent=7, repeated=2, acknowledged=4, silent=True)
    stats.refused["user"] = 3
    labels = 'receiver="192.0.2.7:162",kind="inform"'
    assert lines(NOTIFY_RULES, [receiver_source(stats)]) == [
        f"prostar_gateway_snmp_notifications_total{{{labels}}} 5.0",
        f"prostar_gateway_snmp_notifications_sent_total{{{labels}}} 7.0",
        f"prostar_gateway_snmp_notifications_repeated_total{{{labels}}} 2.0",
        f"prostar_gateway_snmp_notifications_acknowledged_total{{{labels}}} 4.0",
        f"prostar_gateway_snmp_notifications_failed_total{{{labels}}} 0.0",
        f'prostar_gateway_snmp_notifications_refused_total{{{labels},reason="user"}} 3.0',
        f"prostar_gateway_snmp_notifications_waiting{{{labels}}} 0.0",
        f"prostar_gateway_snmp_receiver_silent{{{labels}}} 1.0",
    ]


def document(made: Plant, *, everything: bool) -> list[dict[str, object]]:
    text = b"".join(conditions_pieces(made.conditions, made.now, everything=everything))
    read = json.loads(text)
    assert text == json.dumps(read).encode()
    assert list(read) == ["conditions"]
    found: list[dict[str, object]] = read["conditions"]
    return found


def test_the_document_says_what_is_raised() -> None:
    made = plant()
    raised = document(made, everything=False)
    assert [(each["unit_id"], each["code"]) for each in raised] == [(0, 451), (7, 103), (7, 300)]
    assert raised[1] == {
        "unit_id": 7,
        "device": "d",
        "line": "a",
        "code": 103,
        "condition": "array_fault_battery_hvd",
        "text": "battery high-voltage disconnect",
        "severity": "critical",
        "state": "raised",
        "changed_s_ago": 9.0,
        "times": 1,
    }
    assert (raised[0]["device"], raised[0]["line"]) == (None, None)


def test_everything_is_everything() -> None:
    made = plant()
    found = document(made, everything=True)
    assert len(found) == len(BITS) + 4 + 2 + 1
    assert {each["state"] for each in found} == {"raised", "clear", "unknown"}


@pytest.mark.parametrize("everything", [False, True])
def test_no_piece_takes_longer_than_a_few_conditions(*, everything: bool) -> None:
    """A large site has ten thousand: 40 ms, in which nobody else would be served."""
    made = plant()
    pieces = list(conditions_pieces(made.conditions, made.now, everything=everything))
    assert len(pieces) == len(list(made.conditions)) // WATCHES_A_PIECE + 1
    assert max(piece.count(b'"unit_id"') for piece in pieces) <= WATCHES_A_PIECE


def test_parameters() -> None:
    assert not wants_all({})
    assert not wants_all({"state": "raised"})
    assert wants_all({"state": "all"})
    with pytest.raises(ValueError, match="'clear' is no state; allowed: raised, all"):
        wants_all({"state": "clear"})
    with pytest.raises(ValueError, match="unknown parameter 'device'; allowed: state"):
        wants_all({"device": "d"})


async def test_it_is_asked_by_http(site: Site, clock: ManualClock) -> None:
    conditions = Conditions(site, (HISTORY_DOWN,), clock.now)
    conditions.gateway.tell(HISTORY_DOWN, raised=True, now=clock.now)
    face = HttpFace(
        HttpSettings(listen=(("127.0.0.1", 0),)),
        site,
        clock,
        modbus=ModbusServerStats(),
        snmp=dict,
        not_ready=tuple,
        conditions=conditions,
    )
    listener = face.listeners[0]
    await listener.start()
    assert listener.bound is not None
    host, port = listener.bound
    try:
        async with aiohttp.ClientSession(f"http://{host}:{port}") as session:
            async with session.get("/api/v1/conditions") as reply:
                found = (await reply.json())["conditions"]
                assert [each["condition"] for each in found if each["unit_id"] == 0] == ["history_store_down"]
            async with session.get("/api/v1/conditions?state=odd") as reply:
                assert reply.status == 400
                assert (await reply.json())["error"] == "'odd' is no state; allowed: raised, all"
    finally:
        await listener.stop()
