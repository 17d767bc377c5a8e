"""docs/behaviour.md and docs/service.md: every row names a test that exists, as docs/writes.md does.

The numbers are the code's.
"""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from gateway.core import health
from gateway.faces.http.settings import HttpSettings
from gateway.faces.modbus import connection
from gateway.faces.modbus.settings import ModbusSettings
from gateway.faces.snmp import responder
from gateway.faces.snmp.settings import REPLY_LIMIT
from gateway.lines import serial
from gateway.service import supervisor
from gateway.service.settings import STOP_GRACE_S

PAGE = Path(__file__).parents[2] / "docs" / "behaviour.md"
TEXT = PAGE.read_text()
SERVICE = (PAGE.parent / "service.md").read_text()
NAMED = re.findall(r'\[test\]\((\S+) "(\w+)"\)', TEXT + SERVICE + (PAGE.parent / "writes.md").read_text())
MODBUS, HTTP = ModbusSettings(), HttpSettings()


def test_it_fits_a_page() -> None:
    shown = re.sub(r" ?\[test\]\([^)]*\),?", "", TEXT)
    assert len(shown.split()) < 1200


@pytest.mark.parametrize(("path", "name"), sorted(set(NAMED)))
def test_every_named_test_exists(path: str, name: str) -> None:
    source = (PAGE.parent / path).read_text()
    assert re.search(rf"def {name}\(", source), f"{path} has no {name}"


def test_every_row_has_a_test() -> None:
    rows = [
        row
        for row in (TEXT + SERVICE).splitlines()
        if row.startswith("| ") and not re.match(r"\| (state|situation|what) \|", row)
    ]
    assert len(rows) > 30
    assert [row for row in rows if "[test](" not in row] == []


@pytest.mark.parametrize(
    ("words", "number"),
    [
        ("{} attempts in a row without any reply", health.MISSES_TO_OPEN),
        ("asked once after {} s", health.FIRST_PROBE_S),
        ("at most every {} s", health.LAST_PROBE_S),
        ("(at least {} s) makes room", MODBUS.evict_idle_s),
        ("| no request | {} s |", MODBUS.idle_timeout_s),
        ("| half a request | {} s |", MODBUS.frame_timeout_s),
        ("| {} replies or", connection.MAX_WAITING),
        ("replies or {} bytes", connection.MAX_UNSENT),
        ("others wait for {} of its requests", connection.TURN),
        ("closed after {} s", MODBUS.write_timeout_s),
        ("| SNMP request | {} bytes |", responder.DATAGRAM_LIMIT),
        ("| SNMP reply | {} bytes |", REPLY_LIMIT),
        ("| HTTP connections of an address | {} |", HTTP.max_connections),
        ("| HTTP request header | {} s |", HTTP.idle_timeout_s),
        ("| a reply that a scraper does not take | {} s |", HTTP.send_timeout_s),
        (
            'tried again, at most about {} s apart ([test](../tests/e2e/test_bad_input.py "test_a_busy',
            serial.LAST_RETRY_S,
        ),
        (
            'tried again, at most about {} s apart ([test](../tests/faults/service/test_f79_listeners.py "test_a_taken',
            supervisor.LAST_DELAY_S,
        ),
        ("answered for up to {} s", STOP_GRACE_S),
    ],
)
def test_its_numbers_are_the_codes(words: str, number: float) -> None:
    assert words.format(f"{number:g}") in TEXT
