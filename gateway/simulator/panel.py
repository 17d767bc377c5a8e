"""What the registers say: the state of a `SolarDay` written into a unit's memory, point by point, by name."""

from __future__ import annotations

import math

from gateway.devices.model import DeviceMap, Point, Value
from gateway.simulator.charger import CHARGING, ChargeStage, LoadStage
from gateway.simulator.day import Masks, SolarDay
from gateway.simulator.memory import Memory

_NO_VALUE = math.nan
_MAX_U16 = 65_535
_STAGE_LEDS = {
    ChargeStage.ABSORPTION: "absorption",
    ChargeStage.FLOAT: "float",
    ChargeStage.EQUALIZE: "equalize",
}
_SOC_LEDS = (("green",), ("green_yellow", "green"), ("yellow",), ("yellow_red", "yellow"), ("red_blink",))
"""From a full battery to an empty one; a model without the first of two shows the second."""
_STORED = {
    "stored_hourmeter": "hourmeter",
    "stored_load_charge_resettable": "load_charge_resettable",
    "stored_load_charge_total": "load_charge_total",
    "stored_charge_resettable": "charge_resettable",
    "stored_charge_total": "charge_total",
    "stored_charge_energy_resettable": "charge_energy_resettable",
    "stored_charge_energy_total": "charge_energy_total",
    "battery_voltage_minimum_stored": "battery_voltage_minimum_today",
    "battery_voltage_maximum_stored": "battery_voltage_maximum_today",
    "array_voltage_maximum_stored": "array_voltage_maximum_today",
}


class Labels:
    """Numbers behind the map's labels, by point: of enumerations and bits."""

    def __init__(self, device_map: DeviceMap) -> None:
        self._numbers = {
            (point.name, value.name): value.number
            for point in device_map.points
            for value in device_map.enumerations.get(point.enumeration or "", ())
        }
        self._masks = {
            (point.name, bit.name): 1 << bit.number
            for point in device_map.points
            for bit in device_map.bit_tables.get(point.bits or "", ())
        }

    def number(self, point: str, *labels: str) -> int:
        """The device's number of the first of these states that the model has; 0 when it has none of them."""
        return next((self._numbers[point, label] for label in labels if (point, label) in self._numbers), 0)

    def mask(self, point: str, label: str) -> int:
        """The bit's mask; 0 when the model has no such bit."""
        return self._masks.get((point, label), 0)

    def nature(self) -> Masks:
        """Masks of the causes a `SolarDay` finds."""
        return Masks(
            battery_hvd=self.mask("array_faults", "battery_hvd"),
            load_hvd=self.mask("load_faults", "hvd"),
            heatsink_hot=self.mask("alarms", "heatsink_hot"),
            current_limit=self.mask("alarms", "current_limit"),
            rts_lost=self.mask("alarms", "rts_disconnected"),
            lvd=self.mask("alarms", "lvd"),
        )


def publish(day: SolarDay, memory: Memory, labels: Labels) -> None:
    """Write all measured, counted and decided values of this moment."""
    for values in (_measured(day), _decided(day, labels), _counted(day), _happened(day, labels)):
        for name, value in values.items():
            if memory.has(name):
                memory.set(name, _wrapped(value, memory.point(name)))


def store_totals(day: SolarDay, memory: Memory) -> None:
    """Copy the counters and extremes from RAM to EEPROM, as the unit does every 24 hours."""
    day.keep()
    for stored, live in _STORED.items():
        value = memory.get(live)
        if value is not None:
            memory.set(stored, value)


def _measured(day: SolarDay) -> dict[str, Value]:
    now, plant = day.now, day.plant
    return {
        "charge_current": now.charge_a,
        "array_current": now.array_a,
        "battery_voltage": now.battery_v,
        "array_voltage": now.array_v,
        "load_voltage": now.battery_v - 0.008 * now.load_a if day.load.connected else 0.0,
        "battery_current_net": now.net_a,
        "load_current": now.load_a,
        "battery_sense_voltage": now.battery_v - 0.002 * now.net_a,
        "battery_regulation_voltage": now.battery_v - 0.002 * now.net_a,
        "battery_voltage_slow_60s": now.battery_60s_v,
        "battery_current_net_slow_60s": now.net_60s_a,
        "charge_current_slow_60s": now.charge_60s_a,
        "battery_voltage_slow_25s": now.battery_25s_v,
        "heatsink_temperature": now.heatsink_c,
        "battery_temperature": day.battery_c,
        "ambient_temperature": now.ambient_c,
        "rts_temperature": day.remote_c if plant.has_rts and not day.conditions.rts_lost else _NO_VALUE,
        "inductor_u_temperature": now.inductor_c,
        "inductor_v_temperature": now.inductor_c - 0.8,
        "inductor_w_temperature": now.inductor_c - 1.5 if plant.has_phase_w else _NO_VALUE,
        "charge_power": now.output_w,
        "array_power": now.array_v * now.array_a,
        "sweep_vmp": now.sweep_vmp_v,
        "sweep_pmax": now.sweep_pmax_w,
        "sweep_voc": now.sweep_voc_v,
        "array_target_voltage": now.array_target_v,
    }


def _decided(day: SolarDay, labels: Labels) -> dict[str, Value]:
    charge, load, points = day.charger, day.load, day.points
    return {
        "charge_state": labels.number("charge_state", charge.stage),
        "array_faults": day.array_faults,
        "battery_target_voltage": charge.target_v,
        "load_state": labels.number("load_state", load.stage),
        "load_faults": day.load_faults,
        "load_lvd_voltage_in_force": load.lvd_v(day.now.load_a, points),
        "load_hvd_voltage_in_force": points.load_hvd_v,
        "alarms": day.alarms,
        "led_state": labels.number("led_state", *_battery_led(day)),
        "charge_led_state": labels.number("charge_led_state", _charge_led(day)),
        "equalize_triggered": day.orders.equalize,
        "load_disconnect_forced": day.orders.load_disconnect,
        "charge_disconnect_forced": day.orders.charge_disconnect,
        "time_since_equalize": charge.days_since_equalize,
    }


def _counted(day: SolarDay) -> dict[str, Value]:
    totals, today = day.totals, day.today
    return {
        "charge_resettable": totals.charge_ah_r,
        "charge_total": totals.charge_ah,
        "charge_energy_resettable": totals.charge_kwh_r,
        "charge_energy_total": totals.charge_kwh,
        "load_charge_resettable": totals.load_ah_r,
        "load_charge_total": totals.load_ah,
        "hourmeter": int(day.hours),
        "time_since_battery_service": int((day.hours - totals.service_at_h) / 24),
        "battery_voltage_minimum": min(totals.battery_min_v, day.now.battery_v),
        "battery_voltage_maximum": max(totals.battery_max_v, day.now.battery_v),
        "battery_voltage_minimum_today": min(today.battery_min_v, day.now.battery_v),
        "battery_voltage_maximum_today": max(today.battery_max_v, day.now.battery_v),
        "charge_today": today.charge_ah,
        "load_charge_today": today.load_ah,
        "charge_energy_today": today.charge_kwh,
        "charge_power_maximum_today": today.output_max_w,
        "battery_temperature_minimum_today": min(today.battery_min_c, day.battery_c),
        "battery_temperature_maximum_today": max(today.battery_max_c, day.battery_c),
        "absorption_time_today": min(_MAX_U16, today.absorption_s),
        "equalize_time_today": min(_MAX_U16, today.equalize_s),
        "float_time_today": min(_MAX_U16, today.float_s),
        "array_voltage_maximum_today": today.array_max_v,
    }


def _happened(day: SolarDay, labels: Labels) -> dict[str, Value]:
    """The sticky bits of the day."""
    today = day.today
    reset = labels.mask("alarms", "reset")
    flags = {
        "reset": today.alarms & reset,
        "equalize": today.equalize_s,
        "float": today.float_s,
        "alarm": today.alarms,
        "fault": today.array_faults,
    }
    return {
        "array_faults_today": today.array_faults,
        "load_faults_today": today.load_faults,
        "alarms_today": today.alarms,
        "flags_today": sum(labels.mask("flags_today", name) for name, seen in flags.items() if seen),
    }


def _wrapped(value: Value, point: Point) -> Value:
    """Energy counters of one word begin anew when they are full."""
    if point.unit != "kWh" or point.words > 1:
        return value
    scale = point.reading().scale
    # The nearest step of a value just below the wrap would be 65536 steps.
    return round(value / scale) % (_MAX_U16 + 1) * scale


def _battery_led(day: SolarDay) -> tuple[str, ...]:
    if day.array_faults or day.load_faults:
        return ("error_r_y_g",)
    if day.load.stage is LoadStage.LVD:
        return ("red",)
    stage = _STAGE_LEDS.get(day.charger.stage)
    if stage is not None:
        return (stage,)
    below = sum(day.now.battery_25s_v < limit for limit in day.points.led_limits_v)
    return _SOC_LEDS[below]


def _charge_led(day: SolarDay) -> str:
    stage = day.charger.stage
    if stage in CHARGING:
        return _STAGE_LEDS.get(stage, "green")
    return "yellow" if stage in {ChargeStage.FAULT, ChargeStage.DISCONNECT} else "branch"
