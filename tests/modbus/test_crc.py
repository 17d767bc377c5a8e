from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st
from pymodbus.framer import FramerRTU

from gateway.modbus.crc import append_crc, crc16, crc_ok


def test_check_value() -> None:
    assert crc16(b"123456789") == 0x4B37


def test_no_bytes() -> None:
    assert crc16(b"") == 0xFFFF
    assert not crc_ok(b"")
    assert not crc_ok(b"\xff\xff")  # the CRC of nothing is no frame


@given(st.binary(max_size=300))
def test_equals_pymodbus(data: bytes) -> None:
    assert append_crc(data) == data + FramerRTU.compute_CRC(data).to_bytes(2, "big")


@given(st.binary(min_size=1, max_size=254), st.data())
def test_finds_every_burst_of_sixteen_bits(data: bytes, choose: st.DataObject) -> None:
    frame = append_crc(data)
    assert crc_ok(frame)
    burst = choose.draw(st.integers(1, 0xFFFF)) << choose.draw(st.integers(0, 8 * len(frame) - 16))
    damaged = (int.from_bytes(frame, "little") ^ burst).to_bytes(len(frame), "little")
    assert not crc_ok(damaged)
