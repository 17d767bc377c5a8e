"""Write requests as single writes: the specification's examples, and every other shape refused."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.core.write_request import MAX_COILS, MAX_REGISTERS, SingleWrite, parse_write, success_reply
from gateway.devices.model import Space
from gateway.devices.schema import load_map
from gateway.errors import IllegalDataAddress, IllegalDataValue, IllegalFunction, RequestError

MAP = load_map("prostar-mppt")
REGISTERS, COILS = Space.REGISTERS, Space.COILS


@pytest.mark.parametrize(
    ("request_", "reply", "writes"),
    [
        ("05 00AC FF00", "05 00AC FF00", [(COILS, 172, 1)]),  # §6.5
        ("05 00AC 0000", "05 00AC 0000", [(COILS, 172, 0)]),
        ("06 0001 0003", "06 0001 0003", [(REGISTERS, 1, 3)]),  # §6.6
        (
            "0F 0013 000A 02 CD01",  # §6.11
            "0F 0013 000A",
            [(COILS, 0x13 + at, int(bit)) for at, bit in enumerate("1011001110")],
        ),
        ("10 0001 0002 04 000A 0102", "10 0001 0002", [(REGISTERS, 1, 10), (REGISTERS, 2, 258)]),  # §6.12
    ],
)
def test_the_examples_of_the_specification(request_: str, reply: str, writes: list[tuple[Space, int, int]]) -> None:
    pdu = bytes.fromhex(request_)
    assert parse_write(pdu, MAP) == tuple(SingleWrite(*write) for write in writes)
    assert success_reply(pdu) == bytes.fromhex(reply)


@pytest.mark.parametrize(
    "request_",
    [
        *("06", "06 0001", "06 0001 00", "06 0001 0003 00"),
        *("05 00AC", "05 00AC FF01", "05 00AC 0001", "05 00AC FF00 00"),
        *("0F", "0F 0000 0000 00", "0F 0000 0001 00", "0F 0000 0001 02 0000", "0F 0000 0009 02 00", "0F 0000 0009"),
        *("10 0000 0000 00", "10 0000 0001 02 00", "10 0000 0001 01 0000", "10 0000 0001 02 0000 00", "10 0000 0001"),
        f"10 0000 {MAX_REGISTERS + 1:04X} F8 {'00' * 248}",
        f"0F 0000 {MAX_COILS + 1:04X} F7 {'00' * 247}",
    ],
)
def test_what_is_not_well_formed_is_03(request_: str) -> None:
    with pytest.raises(IllegalDataValue):
        parse_write(bytes.fromhex(request_), MAP)


def test_the_longest_requests_are_taken() -> None:
    assert len(parse_write(bytes.fromhex(f"10 0000 {MAX_REGISTERS:04X} F6 {'00' * 246}"), MAP)) == 123
    assert len(parse_write(bytes.fromhex(f"0F 0000 {MAX_COILS:04X} F6 {'00' * 246}"), MAP)) == 1968


def test_no_range_wraps() -> None:
    assert parse_write(bytes.fromhex("10 FFFF 0001 02 0000"), MAP)
    with pytest.raises(IllegalDataAddress):
        parse_write(bytes.fromhex("10 FFFF 0002 04 0000 0000"), MAP)


@pytest.mark.parametrize("request_", ["16 0004 00F2 0025", "17 0003 0006 000E 0003 06 00FF00FF00FF", "03 0000 0001"])
def test_what_single_writes_cannot_do_is_01(request_: str) -> None:
    with pytest.raises(IllegalFunction):
        parse_write(bytes.fromhex(request_), MAP)


@pytest.mark.parametrize("request_", ["05 0000 FF00", "0F 0000 0001 01 01"])
def test_what_the_model_does_not_write_is_01(request_: str) -> None:
    with pytest.raises(IllegalFunction):
        parse_write(bytes.fromhex(request_), replace(MAP, write_functions={6: REGISTERS}))


@given(
    space=st.sampled_from(Space),
    first=st.integers(0, 0xFFFF),
    values=st.lists(st.integers(0, 0xFFFF), min_size=1, max_size=MAX_REGISTERS),
)
def test_several_are_the_same_as_one_by_one(space: Space, first: int, values: list[int]) -> None:
    values = values[: 0x10000 - first]
    if space is COILS:
        values = [value & 1 for value in values]
        packed = sum(value << at for at, value in enumerate(values)).to_bytes((len(values) + 7) // 8, "little")
        head = b"\x0f"
    else:
        packed = b"".join(value.to_bytes(2) for value in values)
        head = b"\x10"
    pdu = head + first.to_bytes(2) + len(values).to_bytes(2) + bytes([len(packed)]) + packed
    writes = parse_write(pdu, MAP)
    assert writes == tuple(SingleWrite(space, first + at, value) for at, value in enumerate(values))
    assert [parse_write(write.encode(), MAP) for write in writes] == [(write,) for write in writes]


@given(function=st.sampled_from([5, 6, 15, 16, 22, 23]), rest=st.binary(max_size=252))
def test_any_bytes_are_writes_or_one_documented_refusal(function: int, rest: bytes) -> None:
    with suppress(IllegalFunction, IllegalDataValue, IllegalDataAddress):
        assert parse_write(bytes([function]) + rest, MAP)
    assert issubclass(IllegalDataAddress, RequestError)
