"""What a controller answers to which PDU, whatever it holds."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.devices.schema import load_map
from gateway.modbus.pdu import parse_identification, read_identification_request
from gateway.simulator.oracle import OracleController

Client = Any  # the class of conftest.py, which no test module can import

SERIAL_FIRST = 0xE080
EXTENTS = [(0x0000, 0x0051), (0x8000, 0x8FFF), (0xE000, 0xE04F)]


@pytest.mark.parametrize(("first", "last"), EXTENTS)
@pytest.mark.parametrize("function", [3, 4])
def test_registers_end_exactly_where_the_document_ends(client: Client, function: int, first: int, last: int) -> None:
    assert client.request(function, first, 1)[0] == function
    assert client.request(function, last, 1)[0] == function
    assert client.request(function, last, 2) == bytes([function | 0x80, 2])
    assert client.request(function, last + 1, 1) == bytes([function | 0x80, 2])
    if first:
        assert client.request(function, first - 1, 2) == bytes([function | 0x80, 2])


@pytest.mark.parametrize("function", [1, 2])
def test_coils_end_at_0x00ff(client: Client, function: int) -> None:
    assert client.request(function, 0, 256) == bytes([function, 32]) + bytes(32)
    assert client.request(function, 0xFF, 2) == bytes([function | 0x80, 2])


def test_reserved_words_are_readable_and_plain(client: Client) -> None:
    assert client.words(0x0002, 2) == [0, 0]
    assert client.words(0xE039, 7) == [0xFFFF] * 7


@pytest.mark.parametrize("function", [0, 7, 8, 15, 16, 17, 20, 22, 23, 24, 43, 100, 127])
def test_functions_the_device_does_not_know_are_01(client: Client, function: int) -> None:
    assert client.ask(function, 0, 0, 0, 1) == bytes([function | 0x80, 1])


@pytest.mark.parametrize(
    "pdu",
    [
        (3, 0, 0, 0, 0),
        (3, 0, 0, 0, 126),
        (4, 0, 0, 0xFF, 0xFF),
        (1, 0, 0, 0, 0),
        (1, 0, 0, 0x07, 0xD1),
        (3, 0, 0, 0),
        (3, 0, 0, 0, 1, 0),
        (5, 0, 1, 0x12, 0x34),
        (5, 0, 1, 0xFF),
        (6, 0xE0, 0, 0),
        (0x2B, 0x0E, 2, 0),
        (0x2B, 0x0E, 4, 0),
        (0x2B, 0x0E, 1),
    ],
)
def test_wrong_quantities_values_and_lengths_are_03(client: Client, pdu: tuple[int, ...]) -> None:
    assert client.ask(*pdu) == bytes([pdu[0] | 0x80, 3])


def test_a_wrong_quantity_comes_before_a_wrong_address(client: Client) -> None:
    assert client.request(3, 0x1000, 126) == bytes([0x83, 3])


def test_a_range_past_the_address_space_is_02(client: Client) -> None:
    assert client.request(3, 0xFFFF, 2) == bytes([0x83, 2])


def test_identification_is_the_basic_stream(client: Client) -> None:
    reply = parse_identification(client.controller.handle(read_identification_request(), 0.0))
    assert reply.objects == {0: b"Morningstar Corp.", 1: b"PS-MPPT-25M", 2: b"v01.01.13"}
    assert not reply.more_follows


def test_identification_can_start_later_and_restarts_at_an_unknown_object(client: Client) -> None:
    later = parse_identification(client.ask(0x2B, 0x0E, 1, 2))
    unknown = parse_identification(client.ask(0x2B, 0x0E, 1, 0x80))
    assert list(later.objects) == [2]
    assert list(unknown.objects) == [0, 1, 2]


def test_another_mei_type_is_01(client: Client) -> None:
    assert client.ask(0x2B, 0x0D, 1, 0) == bytes([0xAB, 1])


def test_a_silent_unit_answers_nothing_until_its_power_is_back(client: Client) -> None:
    client.controller.silent = True
    assert client.request(3, 0, 1) is None
    client.controller.silent = False
    assert client.request(3, 0, 1) is not None


def test_no_serial_number_by_the_document(client: Client) -> None:
    assert client.request(3, SERIAL_FIRST, 4) == bytes([0x83, 2])


def test_a_serial_number_as_seen_in_the_field(make_client: Any) -> None:
    client = make_client(serial_number="14320017")
    assert b"".join(word.to_bytes(2, "big") for word in client.words(SERIAL_FIRST, 4)) == b"14320017"
    assert client.request(3, SERIAL_FIRST, 5) == bytes([0x83, 2])
    assert client.request(6, SERIAL_FIRST, 0) == bytes([0x86, 2])


@given(pdu=st.binary(min_size=1, max_size=260))
def test_any_pdu_gets_its_own_reply_or_a_documented_exception(pdu: bytes) -> None:
    unit = OracleController(load_map("prostar-mppt"))
    reply = unit.handle(pdu, 0.0)
    assert reply is not None
    assert len(reply) <= 253
    assert reply[0] == pdu[0] or (reply[0] == pdu[0] | 0x80 and len(reply) == 2 and reply[1] in {1, 2, 3})
