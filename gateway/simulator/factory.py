"""The settings a unit leaves the factory with, and the set points that follow from what its EEPROM holds.

Voltages here are for 12 V. A model whose map says that a point is multiplied stores them so and multiplies them itself;
any other stores what holds for its battery.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from gateway.devices.model import Value
from gateway.simulator.charger import SetPoints
from gateway.simulator.memory import Memory
from gateway.simulator.plant import Plant

FACTORY_ADDRESS = 1

FACTORY_SETTINGS: Mapping[str, Value] = MappingProxyType(
    {
        "absorption_voltage": 14.4,
        "float_voltage": 13.7,
        "absorption_time": 10_800,
        "absorption_time_low_battery": 14_400,
        "absorption_extension_voltage": 11.9,
        "float_cancel_voltage": 11.5,
        "float_exit_time": 1_800,
        "equalize_voltage": 14.9,
        "equalize_interval": 28,
        "equalize_time_above_absorption": 10_800,
        "equalize_time": 7_200,
        "battery_service_interval": 180,
        "charge_voltage_limit": 16.0,
        "temperature_compensation": 0.03,
        "battery_hvd_voltage": 16.0,
        "battery_hvr_voltage": 15.0,
        "charge_voltage_maximum": 0.0,
        "compensation_temperature_maximum": 80,
        "compensation_temperature_minimum": -30,
        "stored_foldback_full_output_temperature": -20,
        "stored_foldback_zero_output_temperature": -30,
        "load_lvd_voltage": 11.5,
        "load_lvr_voltage": 12.6,
        "load_hvd_voltage": 16.0,
        "load_hvr_voltage": 15.0,
        "load_lvd_compensation": 0.015,
        "load_lvd_warning_time": 240,
        "led_green_to_green_yellow_voltage": 12.9,
        "led_green_yellow_to_yellow_voltage": 12.4,
        "led_yellow_to_yellow_red_voltage": 12.0,
        "led_yellow_red_to_red_voltage": 11.7,
        "modbus_id": FACTORY_ADDRESS,
        "meterbus_id": 1,
        "stored_array_fixed_voltage": 0.0,
        "stored_array_fixed_fraction": 0.0,
    }
)


def restore_factory_settings(memory: Memory, plant: Plant) -> None:
    """Write every setting's factory value; current limits are the model's rating."""
    for name, value in FACTORY_SETTINGS.items():
        memory.set(name, value * _stored_times(memory, name, plant))
    memory.set("battery_current_limit", plant.rated_a)
    memory.set("charge_current_limit", plant.rated_a)


def set_points(memory: Memory, plant: Plant) -> SetPoints:
    """What the charger works with now; a setting that holds no value counts as 0, as in the firmware's comparison."""

    def plain(name: str) -> float:
        value = memory.get(name)
        return 0.0 if value is None else float(value)

    def volts(name: str) -> float:
        return plain(name) * plant.multiplier / _stored_times(memory, name, plant)

    def limit_a(name: str) -> float:
        return plain(name) if memory.has(name) else plant.rated_a

    limits = [limit for name in ("charge_voltage_maximum", "charge_voltage_limit") if (limit := volts(name)) > 0]
    return SetPoints(
        multiplier=plant.multiplier,
        regulation_v=volts("absorption_voltage"),
        float_v=volts("float_voltage"),
        float_after_s=plain("absorption_time"),
        float_after_low_s=plain("absorption_time_low_battery"),
        float_low_trip_v=volts("absorption_extension_voltage"),
        float_cancel_v=volts("float_cancel_voltage"),
        float_exit_s=plain("float_exit_time"),
        equalize_v=volts("equalize_voltage"),
        equalize_days=plain("equalize_interval"),
        equalize_above_s=plain("equalize_time_above_absorption"),
        equalize_at_s=plain("equalize_time"),
        reference_limit_v=min(limits, default=0.0),
        tempcomp_v=volts("temperature_compensation") / plant.multiplier,
        tempcomp_max_c=plain("compensation_temperature_maximum"),
        tempcomp_min_c=plain("compensation_temperature_minimum"),
        hvd_v=volts("battery_hvd_voltage"),
        hvr_v=volts("battery_hvr_voltage"),
        charge_limit_a=limit_a("charge_current_limit"),
        battery_limit_a=limit_a("battery_current_limit"),
        lvd_v=volts("load_lvd_voltage"),
        lvr_v=volts("load_lvr_voltage"),
        load_hvd_v=volts("load_hvd_voltage"),
        load_hvr_v=volts("load_hvr_voltage"),
        lvd_ohm=plain("load_lvd_compensation"),
        lvd_warning_s=plain("load_lvd_warning_time"),
        led_limits_v=(
            volts("led_green_to_green_yellow_voltage"),
            volts("led_green_yellow_to_yellow_voltage"),
            volts("led_yellow_to_yellow_red_voltage"),
            volts("led_yellow_red_to_red_voltage"),
        ),
    )


def _stored_times(memory: Memory, name: str, plant: Plant) -> int:
    """How many times the 12 V value the EEPROM holds."""
    if not memory.has(name):
        return 1
    point = memory.point(name)
    return plant.multiplier if point.unit in {"V", "V/°C"} and point.multiplied_by is None else 1
