"""Mistakes seen in public code that reads these controllers; each must stay impossible here."""

from __future__ import annotations

import math
import struct

import pytest

from gateway.devices.codecs import decode, encode
from gateway.devices.decode import Decoder
from gateway.devices.model import Space, Value, WordOrder
from gateway.devices.schema import load_map


def _ram(words: dict[int, int], readings: dict[str, str] | None = None) -> dict[str, Value]:
    block = struct.pack(">82H", *(words.get(address, 0) for address in range(82)))
    return Decoder(load_map("prostar-mppt"), readings).decode(Space.REGISTERS, 0, block)


def _eeprom(words: dict[int, int], readings: dict[str, str] | None = None) -> dict[str, Value]:
    block = struct.pack(">80H", *(words.get(address, 0) for address in range(0xE000, 0xE050)))
    return Decoder(load_map("prostar-mppt"), readings).decode(Space.REGISTERS, 0xE000, block)


def _document_sample(value: float) -> int:
    """The document's F32ConvertToF16, with its missing exponent bias."""
    bits: int = struct.unpack(">I", struct.pack(">f", value))[0]
    sign, exponent, fraction = bits >> 31, (bits >> 23 & 0xFF) - 127, (bits & 0x7FFFFF) >> 13
    return ((sign << 15) + (exponent << 10) + fraction) & 0xFFFF


def test_the_documents_sample_encoder_is_not_followed() -> None:
    assert _document_sample(14.4) == 0x0F33
    assert decode("f16", (0x0F33,), WordOrder.HI_LO, 1.0) == pytest.approx(0.00044, abs=0.00001)
    assert encode("f16", 14.4, 1, WordOrder.HI_LO, 1.0) == (0x4B33,)
    assert decode("f16", (_document_sample(0.5),), WordOrder.HI_LO, 1.0) is None, "0.5 became minus infinity"


def test_half_floats_are_not_integers() -> None:
    assert _ram({0x12: 0x4AA0})["battery_voltage"] == 13.25


def test_ampere_hours_are_one_unsigned_pair() -> None:
    values = _ram({0x28: 0x0000, 0x29: 0x8000, 0x34: 0x0001, 0x35: 0x0000})
    assert values["charge_total"] == 3276.8
    assert values["load_charge_total"] == 6553.6


@pytest.mark.parametrize(("word", "times"), [(0x3C00, 1), (0x4000, 2), (0x0001, 1), (0x0002, 2)])
def test_voltage_multiplier_reads_both_forms(word: int, times: int) -> None:
    assert _ram({0x01: word})["settings_voltage_multiplier"] == times


@pytest.mark.parametrize("word", [0x003C, 0x0040, 0x0100, 0x0200])
def test_voltage_multiplier_is_not_byte_swapped(word: int) -> None:
    assert "settings_voltage_multiplier" not in _ram({0x01: word})


def test_voltage_multiplier_touches_no_measurement() -> None:
    assert _ram({0x01: 0x4000, 0x12: 0x4AA0})["battery_voltage"] == 13.25


def test_a_missing_sensor_has_no_value() -> None:
    values = _ram({0x1D: 0x7E00, 0x20: 0xFE00})
    assert "rts_temperature" not in values
    assert "inductor_w_temperature" not in values
    assert all(math.isfinite(value) for value in values.values())


def test_no_battery_percentage_is_invented() -> None:
    device_map = load_map("prostar-mppt")
    assert not [point.name for point in device_map.points if "percent" in point.name or "charge_level" in point.name]
    assert "%" not in {point.unit for point in device_map.points}


def test_software_version_is_decimal() -> None:
    assert _ram({0x00: 0x0013})["software_version"] == 13


def test_worked_example_of_the_document() -> None:
    assert _ram({0x36: 0x0022, 0x37: 0x13D8})["hourmeter"] == 2_233_304


def test_high_and_low_words_stand_differently_in_ram_and_eeprom() -> None:
    assert _ram({0x36: 1, 0x37: 2})["hourmeter"] == 65538
    assert _eeprom({0xE040: 2, 0xE041: 1})["stored_hourmeter"] == 65538
    assert _eeprom({0xE040: 1, 0xE041: 2}, {"stored_hourmeter": "hi_lo"})["stored_hourmeter"] == 65538


def test_energy_is_tenths_unless_the_device_says_half_float() -> None:
    assert _ram({0x2B: 1234})["charge_energy_total"] == 123.4
    assert _ram({0x2B: 0x57B6}, {"charge_energy_total": "f16"})["charge_energy_total"] == 123.375


def test_warning_time_is_minutes_unless_the_device_says_seconds() -> None:
    assert _eeprom({0xE027: 4})["load_lvd_warning_time"] == 240
    assert _eeprom({0xE027: 240}, {"load_lvd_warning_time": "seconds"})["load_lvd_warning_time"] == 240


@pytest.mark.parametrize("word", [0xFFF6, 0x00F6])
def test_negative_limits_are_negative(word: int) -> None:
    assert _eeprom({0xE01F: word})["compensation_temperature_minimum"] == -10
