"""Worked examples of the Modbus Application Protocol V1.1b3; the ids are its clauses.

Addresses in the document's tables count from 1, those in its PDUs from 0; the PDUs stand here. Object lengths of 6.21
are those of its texts.
"""

from __future__ import annotations

from dataclasses import dataclass

import pytest

from gateway.errors import IllegalDataAddress, IllegalDataValue, IllegalFunction
from gateway.modbus.counters import RtuCounters
from gateway.modbus.crc import append_crc
from gateway.modbus.pdu import (
    MAX_PDU,
    ReadRequest,
    exception_reply,
    expected_reply_size,
    is_exception,
    parse_identification,
    parse_read,
    read_identification_request,
    reply_fits,
)
from gateway.modbus.rtu import RtuClient, Timing
from gateway.modbus.transactions import Replied


@dataclass(frozen=True)
class Example:
    request: bytes
    reply: bytes


def hexes(request: str, reply: str) -> Example:
    return Example(bytes.fromhex(request), bytes.fromhex(reply))


READS = {
    "6.1 read coils 20 to 38": (hexes("01 0013 0013", "01 03 CD6B05"), ReadRequest(1, 0x13, 19)),
    "6.2 read discrete inputs 197 to 218": (hexes("02 00C4 0016", "02 03 ACDB35"), ReadRequest(2, 0xC4, 22)),
    "6.3 read holding registers 108 to 110": (
        hexes("03 006B 0003", "03 06 022B 0000 0064"),
        ReadRequest(3, 0x6B, 3),
    ),
    "6.4 read input register 9": (hexes("04 0008 0001", "04 02 000A"), ReadRequest(4, 8, 1)),
}

WRITES = {
    "6.5 write single coil 173 on": hexes("05 00AC FF00", "05 00AC FF00"),
    "6.6 write single register 2": hexes("06 0001 0003", "06 0001 0003"),
}

IDENTIFICATION = Example(
    bytes.fromhex("2B 0E 01 00"),
    bytes.fromhex("2B 0E 01 01 00 00 03")
    + b"\x00\x16Company identification"
    + b"\x01\x0fProduct code XX"
    + b"\x02\x05V2.11",
)

EXAMPLES = {name: example for name, (example, _) in READS.items()} | WRITES | {"6.21 identification": IDENTIFICATION}


@pytest.mark.parametrize(("example", "read"), READS.values(), ids=READS)
def test_clause_6_read_request(example: Example, read: ReadRequest) -> None:
    assert read.encode() == example.request
    assert parse_read(example.request) == read
    assert expected_reply_size(example.request) == len(example.reply)


@pytest.mark.parametrize("example", EXAMPLES.values(), ids=EXAMPLES)
def test_clause_6_reply_is_accepted_and_only_whole(example: Example) -> None:
    assert reply_fits(example.request, example.reply)
    assert not reply_fits(example.request, example.reply[:-1])
    assert not reply_fits(example.request, example.reply + b"\x00")


@pytest.mark.parametrize("example", EXAMPLES.values(), ids=EXAMPLES)
def test_clause_6_reply_travels_over_a_serial_line(example: Example) -> None:
    client = RtuClient(Timing.of(19200, 8, "E", 1), RtuCounters(), quarantine_s=0.1)
    warm_up, answer = bytes.fromhex("03 0000 0001"), bytes.fromhex("03 02 0000")
    client.send(17, warm_up, 0.0, 0.5)  # shows that this line has no echo
    client.receive(append_crc(b"\x11" + answer), 0.1)

    assert client.send(17, example.request, 1.0, 0.5) == append_crc(b"\x11" + example.request)
    assert client.receive(append_crc(b"\x11" + example.reply), 1.1) == Replied(example.reply, 1.0, 1.1)


def test_clause_6_21_identification_example() -> None:
    assert read_identification_request() == IDENTIFICATION.request
    reply = parse_identification(IDENTIFICATION.reply)
    assert reply.objects == {0: b"Company identification", 1: b"Product code XX", 2: b"V2.11"}
    assert not reply.more_follows


def test_clause_6_21_identification_in_two_transactions() -> None:
    first = parse_identification(bytes.fromhex("2B 0E 01 01 FF 02 02") + b"\x00\x03abc\x01\x02de")
    assert first.more_follows
    assert read_identification_request(first.next_id) == bytes.fromhex("2B 0E 01 02")
    second = parse_identification(bytes.fromhex("2B 0E 01 01 00 00 01") + b"\x02\x05V2.11")
    assert first.objects | second.objects == {0: b"abc", 1: b"de", 2: b"V2.11"}
    assert not second.more_follows


@pytest.mark.parametrize("function", [1, 2, 3, 4, 5, 6, 0x2B], ids=lambda function: f"7 function {function:02X}")
def test_clause_7_exception_is_the_function_with_bit_7_and_a_code(function: int) -> None:
    assert exception_reply(function, 2) == bytes((function + 0x80, 2))
    assert is_exception(exception_reply(function, 2))


def test_clause_7_worked_example_read_coil_1186_of_a_device_that_has_none() -> None:
    request = bytes.fromhex("01 04A1 0001")
    assert parse_read(request) == ReadRequest(1, 0x04A1, 1)
    assert exception_reply(1, 2) == bytes.fromhex("81 02")
    assert reply_fits(request, bytes.fromhex("81 02"))


def test_clause_4_1_longest_pdu() -> None:
    assert MAX_PDU == 253


@pytest.mark.parametrize(
    ("pdu", "fits"),
    [
        ("01 0000 0001", True),
        ("01 0000 07D0", True),
        ("01 0000 0000", False),
        ("01 0000 07D1", False),
        ("02 0000 07D0", True),
        ("02 0000 07D1", False),
        ("03 0000 007D", True),
        ("03 0000 0000", False),
        ("03 0000 007E", False),
        ("04 0000 007D", True),
        ("04 0000 007E", False),
    ],
    ids=lambda value: f"6.{int(value[:2], 16)} {value}" if isinstance(value, str) else str(value),
)
def test_clauses_6_1_to_6_4_quantity_out_of_range_is_exception_03(pdu: str, fits: bool) -> None:
    if fits:
        assert parse_read(bytes.fromhex(pdu)).encode() == bytes.fromhex(pdu)
    else:
        with pytest.raises(IllegalDataValue) as refusal:
            parse_read(bytes.fromhex(pdu))
        assert refusal.value.exception_code == 3


@pytest.mark.parametrize("pdu", ["01 FFFF 0002", "03 FFF0 0011"], ids=lambda pdu: f"6.{int(pdu[:2], 16)} {pdu}")
def test_clauses_6_1_to_6_4_range_past_the_last_address_is_exception_02(pdu: str) -> None:
    with pytest.raises(IllegalDataAddress) as refusal:
        parse_read(bytes.fromhex(pdu))
    assert refusal.value.exception_code == 2


@pytest.mark.parametrize("value", ["0001", "FF01", "00FF", "FFFF"])
def test_clause_6_5_coil_values_are_0000_and_ff00(value: str) -> None:
    with pytest.raises(IllegalDataValue) as refusal:
        expected_reply_size(bytes.fromhex("05 00AC" + value))
    assert refusal.value.exception_code == 3


def test_clause_6_21_read_device_id_codes_are_1_to_4_and_the_mei_type_0e() -> None:
    for code in range(1, 5):
        assert expected_reply_size(bytes((0x2B, 0x0E, code, 0))) is None
    for code in (0, 5):
        with pytest.raises(IllegalDataValue):
            expected_reply_size(bytes((0x2B, 0x0E, code, 0)))
    with pytest.raises(IllegalFunction):
        expected_reply_size(bytes((0x2B, 0x0D, 1, 0)))
