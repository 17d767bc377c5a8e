"""What a write does to a controller.

Rules (ProStar MPPT v05 and TriStar MPPT v11, "Write Single Register", coil tables and definitions; a unit does what its
map has points for):

1. An EEPROM write is not verified. It raises "EEPROM setting edit" in both fault fields until a reset, or, from
   firmware 13 with setting_change_signal 1, the alarm "setting changed" instead.
2. Set-only coils act when written with 1 and always read 0; clear_faults and clear_alarms leave what needs a reset.
3. reset_control and factory_reset reboot the unit without an answer; RAM then begins with what EEPROM holds, the
   counters too, which are stored once in 24 hours and when force_eeprom_update says so.
   factory_reset also puts every setting back, the Modbus address included.
4. Slave control (voltage; a TriStar has a current too) must be written again within the time in the map, else the unit
   faults; writing again ends the fault. What ends the control is in the map.
5. Fixed array voltage and fraction work from RAM at once.
6. What has no point, or a point that is only for reading, is refused (exception 02). The lighting test is confirmed
   and does nothing: no simulated unit is in lighting mode.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

from gateway.devices.model import Access, Group, Point, Space
from gateway.simulator.day import SolarDay
from gateway.simulator.factory import restore_factory_settings, set_points
from gateway.simulator.memory import Memory
from gateway.simulator.panel import Labels, store_totals

_CONTROLS = {"battery_target_voltage_slave": "slave_v", "charge_current_limit_slave": "slave_a"}
"""Point → the order that it gives."""

_SIGNAL_BY_ALARM = 1
_FIRST_FIRMWARE_WITH_ALARM = 13


def accepts_writes(point: Point) -> bool:
    """Whether the unit takes a write to the point's cells."""
    return point.access is not Access.READ or point.group is Group.COMMAND


class Commands:
    """The write rules of one unit."""

    def __init__(self, memory: Memory, day: SolarDay, labels: Labels, firmware: int) -> None:
        self._deadlines: dict[str, float] = {}  # point that controls the unit → when it must have been written again
        self._memory = memory
        self._day = day
        self._labels = labels
        self._firmware = firmware
        self._switches: Mapping[str, Callable[[int], None]] = {
            "equalize_triggered": self._trigger_equalize,
            "load_disconnect_forced": self._disconnect_load,
            "charge_disconnect_forced": self._disconnect_charge,
        }
        self._pulses: Mapping[str, Callable[[], None]] = {
            "clear_charge_resettable": self._clear_charge_resettable,
            "clear_charge_total": self._clear_charge_total,
            "clear_energy_resettable": self._clear_energy_resettable,
            "clear_energy_total": self._clear_energy_total,
            "clear_faults": self._clear_faults,
            "clear_alarms": self._clear_alarms,
            "force_eeprom_update": self._force_eeprom_update,
            "clear_battery_voltage_extremes": self._clear_extremes,
            "reset_battery_service": self._reset_service,
        }
        self._reboots: Mapping[str, Callable[[], None]] = {
            "factory_reset": self._restore_settings,
            "reset_control": lambda: None,
        }

    @property
    def slave_deadline(self) -> float:
        """When slave control ends for lack of a refresh."""
        return min(self._deadlines.values(), default=math.inf)

    def write_coil(self, point: Point, value: int) -> bool:
        """Execute a write of 0 or 1; False when the unit reboots and does not answer."""
        if point.name in self._switches:
            self._switches[point.name](value)
        elif value and point.name in self._pulses:
            self._pulses[point.name]()
        elif value and point.name in self._reboots:
            self._reboots[point.name]()
            self._restart()
            return False
        return True

    def write_register(self, point: Point, address: int, value: int, now: float) -> None:
        """Store a word and let it act."""
        self._memory.store(Space.REGISTERS, address, value)
        if self._memory.in_eeprom(Space.REGISTERS, address):
            self._raise_setting_edit()
            self._day.points = set_points(self._memory, self._day.plant)
            return
        orders = self._day.orders
        if point.rewrite_s is not None:
            self._control(point, point.rewrite_s, value, now)
        orders.fixed_array_v = self._positive("array_fixed_voltage")
        orders.fixed_array_fraction = self._positive("array_fixed_fraction")

    def slave_timed_out(self) -> None:
        """Nobody refreshed the slave voltage: fault, until it is written again."""
        self._end_slave_control()
        self._day.orders.array_faults |= self._labels.mask("array_faults", "slave_timeout")

    def boot(self) -> None:
        """Start up: RAM begins with what EEPROM holds."""
        memory, orders = self._memory, self._day.orders
        for name in _CONTROLS:
            memory.set(name, 0.0)
        orders.fixed_array_v = self._positive("stored_array_fixed_voltage")
        orders.fixed_array_fraction = self._positive("stored_array_fixed_fraction")
        memory.set("array_fixed_voltage", orders.fixed_array_v)
        memory.set("array_fixed_fraction", orders.fixed_array_fraction)
        by_alarm = memory.get("stored_setting_change_signal") == _SIGNAL_BY_ALARM
        memory.set("setting_change_signal", _SIGNAL_BY_ALARM if by_alarm else 0)
        for name in ("foldback_full_output_temperature", "foldback_zero_output_temperature"):
            memory.set(name, memory.get(f"stored_{name}") or 0)
        self._day.points = set_points(memory, self._day.plant)

    def _restart(self) -> None:
        orders = self._day.orders
        self._end_slave_control()
        orders.array_faults = orders.load_faults = 0
        orders.alarms = self._labels.mask("alarms", "reset")
        orders.equalize = orders.load_disconnect = orders.charge_disconnect = False
        self.boot()
        self._day.restart()

    def _raise_setting_edit(self) -> None:
        orders, labels = self._day.orders, self._labels
        by_alarm = self._memory.get("setting_change_signal") == _SIGNAL_BY_ALARM
        if by_alarm and self._firmware >= _FIRST_FIRMWARE_WITH_ALARM:
            orders.alarms |= labels.mask("alarms", "setting_changed")
            return
        orders.array_faults |= labels.mask("array_faults", "eeprom_edited")
        orders.load_faults |= labels.mask("load_faults", "eeprom_edited")

    def _positive(self, name: str) -> float:
        value = self._memory.get(name)
        return float(value) if value is not None and value > 0 else 0.0

    def _control(self, point: Point, rewrite_s: float, word: int, now: float) -> None:
        """Rule 4."""
        orders = self._day.orders
        orders.array_faults &= ~self._labels.mask("array_faults", "slave_timeout")
        order = _CONTROLS[point.name]
        if not point.released.held_by(word, held=point.name in self._deadlines):
            self._deadlines.pop(point.name, None)
            setattr(orders, order, 0.0)
            return
        self._deadlines[point.name] = now + rewrite_s
        if word:
            setattr(orders, order, self._positive(point.name))

    def _end_slave_control(self) -> None:
        self._day.orders.slave_v = self._day.orders.slave_a = 0.0
        self._deadlines.clear()

    def _restore_settings(self) -> None:
        restore_factory_settings(self._memory, self._day.plant)

    def _trigger_equalize(self, value: int) -> None:
        self._day.orders.equalize = value == 1 and self._day.points.equalize_v > 0

    def _disconnect_load(self, value: int) -> None:
        self._day.orders.load_disconnect = value == 1

    def _disconnect_charge(self, value: int) -> None:
        self._day.orders.charge_disconnect = value == 1

    def _clear_charge_resettable(self) -> None:
        totals = self._day.totals
        totals.charge_ah_r = totals.load_ah_r = 0.0
        totals.battery_min_v = totals.battery_max_v = self._day.now.battery_v

    def _clear_charge_total(self) -> None:
        self._day.totals.charge_ah = self._day.totals.load_ah = 0.0

    def _clear_energy_resettable(self) -> None:
        self._day.totals.charge_kwh_r = 0.0

    def _clear_energy_total(self) -> None:
        self._day.totals.charge_kwh = 0.0

    def _clear_faults(self) -> None:
        orders, labels = self._day.orders, self._labels
        orders.array_faults &= labels.mask("array_faults", "eeprom_edited")
        orders.load_faults &= labels.mask("load_faults", "eeprom_edited")

    def _clear_alarms(self) -> None:
        self._day.orders.alarms &= self._labels.mask("alarms", "setting_changed")

    def _force_eeprom_update(self) -> None:
        store_totals(self._day, self._memory)

    def _clear_extremes(self) -> None:
        today, volts = self._day.today, self._day.now.battery_v
        today.battery_min_v = today.battery_max_v = volts
        self._day.totals.battery_min_v = self._day.totals.battery_max_v = volts
        for name in ("battery_voltage_minimum_stored", "battery_voltage_maximum_stored"):
            self._memory.set(name, volts)

    def _reset_service(self) -> None:
        self._day.totals.service_at_h = self._day.hours
