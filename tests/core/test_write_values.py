"""Which values may be written."""

from __future__ import annotations

import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.core.write_values import check_value
from gateway.devices.model import Access, Point
from gateway.devices.schema import load_map
from gateway.errors import IllegalDataValue

MAP = load_map("prostar-mppt")
WRITABLE = [point for point in MAP.points if point.access is not Access.READ]


def half(value: float) -> int:
    return int(struct.unpack(">H", struct.pack(">e", value))[0])


@pytest.mark.parametrize(
    ("name", "word", "value"),
    [
        ("absorption_voltage", half(14.4), 14.3984375),
        ("battery_target_voltage_slave", half(0.0), 0.0),
        ("battery_target_voltage_slave", half(28.5), 28.5),
        ("charge_current_limit", half(40.0), 40.0),
        ("stored_array_fixed_fraction", half(0.5), 0.5),
        ("setting_change_signal", 1, 1),
        ("modbus_id", 247, 247),
        ("compensation_temperature_minimum", 0xFFE2, -30),
        ("load_lvd_warning_time", 2, 120),
        ("equalize_interval", 255, 255),
        ("load_disconnect_forced", 0, 0),
        ("reset_control", 1, 1),
    ],
)
def test_values_within_the_limits(name: str, word: int, value: float) -> None:
    assert check_value(MAP.point(name), word, MAP) == value


@pytest.mark.parametrize(
    ("name", "word"),
    [
        *(("absorption_voltage", word) for word in (0x7E00, 0x7C00, 0xFC00, 0xFFFF)),  # NaN, +inf, -inf, erased
        ("battery_target_voltage_slave", half(-1.0)),
        ("battery_target_voltage_slave", half(300.0)),  # nothing that would be believed when it is read
        ("charge_current_limit", half(40.03125)),
        ("stored_array_fixed_fraction", half(1.0)),
        ("setting_change_signal", 2),
        ("modbus_id", 0),
        ("modbus_id", 248),
        ("meterbus_id", 16),
        ("compensation_temperature_minimum", 0x1234),
        ("equalize_interval", 256),
        ("reset_control", 0),  # can only be set
        ("clear_charge_total", 0),
    ],
)
def test_f42_values_outside_are_03(name: str, word: int) -> None:
    with pytest.raises(IllegalDataValue, match=name):
        check_value(MAP.point(name), word, MAP)


def test_limits_are_in_the_unit_of_the_reading_that_the_device_is_read_with() -> None:
    point = MAP.point("load_lvd_warning_time")
    assert check_value(point, 600, MAP, "seconds") == 600
    assert check_value(point, 600, MAP) == 36000


@given(point=st.sampled_from(WRITABLE), word=st.integers(0, 0xFFFF))
def test_any_word_is_a_value_within_the_limits_or_03(point: Point, word: int) -> None:
    word = word & 1 if point.space.value == "coils" else word
    try:
        value = check_value(point, word, MAP)
    except IllegalDataValue:
        return
    assert point.minimum is None or value >= point.minimum
    assert point.maximum is None or value <= point.maximum
    assert math.isfinite(value)
