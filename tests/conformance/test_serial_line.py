"""Modbus over Serial Line V1.02; the clauses are in the names."""

from __future__ import annotations

import pytest

from gateway.modbus.counters import RtuCounters
from gateway.modbus.crc import append_crc, crc16, crc_ok
from gateway.modbus.frames import MAX_FRAME, UNIT_ADDRESSES
from gateway.modbus.rtu import RtuClient, Timing

READ = bytes.fromhex("03 0000 0001")
REPLY = append_crc(bytes.fromhex("11 03 02 0000"))


def test_appendix_b_crc_of_02_07_is_1241_and_its_low_byte_goes_first() -> None:
    assert crc16(b"\x02\x07") == 0x1241
    assert append_crc(b"\x02\x07") == bytes.fromhex("0207 4112")
    assert crc_ok(bytes.fromhex("0207 4112"))
    assert not crc_ok(bytes.fromhex("0207 1241"))


def test_appendix_b_first_step_register_preloaded_with_ones() -> None:
    assert crc16(b"") == 0xFFFF


def test_2_2_single_devices_have_addresses_1_to_247() -> None:
    assert (UNIT_ADDRESSES[0], UNIT_ADDRESSES[-1]) == (1, 247)
    client = RtuClient(Timing.of(19200, 8, "E", 1), RtuCounters(), quarantine_s=0.1)
    for address in (0, 248, 255):
        with pytest.raises(ValueError, match=r"not in 1\.\.247"):
            client.send(address, READ, 0.0, 0.5)


def test_2_5_1_frame_is_address_pdu_crc_and_at_most_256_bytes() -> None:
    client = RtuClient(Timing.of(19200, 8, "E", 1), RtuCounters(), quarantine_s=0.1)
    frame = client.send(17, READ, 0.0, 0.5)
    assert frame[0] == 17
    assert frame[1:-2] == READ
    assert crc_ok(frame)
    assert MAX_FRAME == 256


@pytest.mark.parametrize("setting", [(19200, 8, "E", 1), (19200, 8, "N", 2)])
def test_2_5_1_a_character_has_eleven_bits_with_or_without_parity(setting: tuple[int, int, str, int]) -> None:
    assert Timing.of(*setting).char_s == pytest.approx(11 / 19200)


@pytest.mark.parametrize("baudrate", [1200, 9600, 19200])
def test_2_5_1_1_frames_are_3_5_characters_apart(baudrate: int) -> None:
    timing = Timing.of(baudrate, 8, "E", 1)
    client = RtuClient(timing, RtuCounters(), quarantine_s=0.1)
    client.send(17, READ, 0.0, 0.5)
    client.receive(REPLY, 0.3)
    assert client.ready_at(0.3) == pytest.approx(0.3 + 3.5 * 11 / baudrate)


@pytest.mark.parametrize("baudrate", [38400, 57600, 115200])
def test_2_5_1_1_above_19200_baud_the_gap_is_1_750_ms(baudrate: int) -> None:
    client = RtuClient(Timing.of(baudrate, 8, "E", 1), RtuCounters(), quarantine_s=0.1)
    client.send(17, READ, 0.0, 0.5)
    client.receive(REPLY, 0.3)
    assert client.ready_at(0.3) == pytest.approx(0.30175)


def test_2_4_1_reply_of_an_unexpected_unit_keeps_the_timer_running() -> None:
    counters = RtuCounters()
    client = RtuClient(Timing.of(19200, 8, "E", 1), counters, quarantine_s=0.1)
    client.send(17, READ, 0.0, 0.5)
    deadline = client.next_deadline()
    assert client.receive(append_crc(bytes.fromhex("12 03 02 0000")), 0.1) is None
    client.on_timer(0.2)
    assert client.next_deadline() == deadline
    assert client.receive(REPLY, 0.3) is not None
    assert counters.wrong_unit == 1
