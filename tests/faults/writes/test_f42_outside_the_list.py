"""F42: a write outside of what a rule allows, or with a range only partly inside, is refused whole; nothing is sent."""

from __future__ import annotations

from ipaddress import ip_network
from pathlib import Path

import pytest

from gateway.core.write_rules import Range, WriteRule
from tests.faces.modbus.writing import writing

ME = (ip_network("127.0.0.1"),)
RULE = WriteRule(ME, unit_ids=frozenset({11}), registers=(Range(0xE000, 0xE003),), coils=(Range(0x01, 0xFF),))


@pytest.mark.parametrize(
    "request_",
    [
        *("06 e004 4a00", "06 dfff 0000", "06 0025 4b00"),  # beside the range
        *("10 e003 0002 04 1388 4a00", "10 dfff 0002 04 0000 4b64"),  # across its ends
        "10 e000 0005 0a 4b64 4b10 2328 1388 4a00",
        *("05 0000 ff00", "0f 0000 0002 01 02"),
        *("05 00fe ff00", "05 00ff ff00", "05 0010 ff00", "05 0018 ff00"),  # within, but to be named
        *("0f 0001 0003 01 00", "05 0003 ff00"),  # within, but reserved
        *("05 0020 ff00", "05 0020 0000"),  # the lighting test, for reading only
    ],
)
async def test_it_is_01_and_nothing_is_sent(tmp_path: Path, request_: str) -> None:
    async with writing(tmp_path, RULE) as it:
        assert await it.query(request_) == f"{int(request_[:2], 16) | 0x80:02x}01"
        assert not it.line.sent
        assert it.stats.refused == {"write_not_allowed": 1}
        assert it.ledger() == []


@pytest.mark.parametrize(
    "request_", ["06 e000 7e00", "06 e000 fc00", "10 e000 0002 04 4b64 7e00", "10 e002 0002 04 2328 1388 00"]
)
async def test_a_value_outside_its_limits_is_03_for_the_whole_request(tmp_path: Path, request_: str) -> None:
    async with writing(tmp_path, RULE) as it:
        assert (await it.query(request_))[2:] == "03"
        assert not it.line.sent


@pytest.mark.parametrize("unit", [11, 12])
async def test_another_network_may_nothing(tmp_path: Path, unit: int) -> None:
    async with writing(tmp_path, WriteRule((ip_network("192.0.2.0/24"),), registers=RULE.registers)) as it:
        assert await it.query("06 e000 4b64", unit=unit) == "8601"
        assert not it.line.sent
        assert it.stats.refused == {"no_write_rule": 1}


async def test_what_is_inside_is_written(tmp_path: Path) -> None:
    async with writing(tmp_path, RULE) as it:
        assert await it.query("10 e000 0004 08 4b64 4b10 2328 1388") == "10e0000004"
        assert [it.holds(at) for at in range(0xE000, 0xE004)] == [0x4B64, 0x4B10, 0x2328, 0x1388]
