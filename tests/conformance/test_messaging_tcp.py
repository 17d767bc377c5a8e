"""Modbus Messaging on TCP/IP Implementation Guide V1.0b; the clauses are in the names."""

from __future__ import annotations

from gateway.modbus.mbap import MAX_ADU, Adu, MbapSplitter, encode
from gateway.modbus.pdu import ReadRequest, parse_read

EXAMPLE = bytes.fromhex("1501 0000 0006 FF 03 0004 0001")


def test_4_4_1_1_worked_example_read_register_5() -> None:
    assert encode(0x1501, 0xFF, ReadRequest(3, 4, 1).encode()) == EXAMPLE
    (adu,) = MbapSplitter().feed(EXAMPLE)
    assert adu == Adu(0x1501, 0xFF, bytes.fromhex("03 0004 0001"))
    assert parse_read(adu.pdu) == ReadRequest(3, 4, 1)


def test_3_1_3_length_counts_unit_identifier_and_pdu() -> None:
    assert encode(0, 1, bytes(253))[4:6] == (254).to_bytes(2, "big")
    assert len(encode(0, 1, bytes(253))) == MAX_ADU == 260


def test_3_1_3_all_fields_are_big_endian() -> None:
    assert encode(0x0102, 3, b"\x04") == bytes.fromhex("0102 0000 0002 03 04")


def test_4_4_2_2_adu_of_another_protocol_is_discarded() -> None:
    splitter = MbapSplitter()
    other = EXAMPLE[:2] + bytes.fromhex("0001") + EXAMPLE[4:]
    assert [adu.tid for adu in splitter.feed(other + EXAMPLE)] == [0x1501]
    assert (splitter.foreign, splitter.lost) == (1, None)


def test_4_2_2_segment_borders_mean_nothing() -> None:
    splitter = MbapSplitter()
    found = [adu for byte in EXAMPLE + EXAMPLE for adu in splitter.feed(bytes((byte,)))]
    assert found == [Adu(0x1501, 0xFF, bytes.fromhex("03 0004 0001"))] * 2
