"""A simulated controller: registers that follow a plausible day, and writes with the document's consequences.

Write rules (ProStar MPPT v05, "Write Single Register", coil table and definitions):

1. An EEPROM write is not verified. It raises "EEPROM setting edit" in both fault fields until a reset, or, from
   firmware 13 with setting_change_signal 1, the alarm "setting changed" instead.
2. Set-only coils act when written with 1 and always read 0; clear_faults leaves what needs a reset.
3. reset_control and factory_reset reboot the unit: no reply, and no reply to anything for `reboot_s`. The Modbus
   address is the EEPROM's from then on; factory_reset makes it 1 again.
4. battery_target_voltage_slave must be written at least every 60 s while it is not 0, else the unit faults;
   writing it again ends the fault.
5. Fixed array voltage and share work from RAM at once; a reset copies them from EEPROM.
6. What has no point, or a point that is only for reading, is refused with exception 02.

Registers move with virtual time (`speed` times as fast as the line); reboot and slave time-out are the line's time.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Mapping

from gateway.devices.model import Access, DeviceMap, Extent, Group, Point, PollClass, Space, WordOrder
from gateway.simulator.daily_log import DailyLog, past_day
from gateway.simulator.day import SolarDay, Today, Totals
from gateway.simulator.factory import FACTORY_ADDRESS, restore_factory_settings, set_points
from gateway.simulator.memory import Memory
from gateway.simulator.panel import Labels, publish, store_totals
from gateway.simulator.plant import PLANTS, Plant
from gateway.simulator.server import Controller, missing

DEFAULT_TURNAROUND_S = 0.015

_SLAVE_TIMEOUT_S = 60.0
_SIGNAL_BY_ALARM = 1
_FIRST_FIRMWARE_WITH_ALARM = 13
_MAX_ADDRESS = 247
_LOG_HISTORY = 256


class SimulatedController(Controller):
    """One unit on a line; `plant` is what it is bolted to, by default one of `PLANTS` chosen by the seed.

    `serial_number` adds the undocumented ASCII registers; `log_order` is the word order of the daily log.
    """

    def __init__(
        self,
        device_map: DeviceMap,
        *,
        address: int = FACTORY_ADDRESS,
        seed: int = 0,
        plant: Plant | None = None,
        speed: float = 1.0,
        start_hour: float = 9.0,
        step_s: float = 5.0,
        turnaround_s: float = DEFAULT_TURNAROUND_S,
        reboot_s: float = 3.0,
        firmware: int = 13,
        serial_number: str | None = None,
        log_order: WordOrder = WordOrder.HI_LO,
    ) -> None:
        super().__init__(device_map, address, turnaround_s)
        self.plant = plant or PLANTS[seed % len(PLANTS)]
        self._seed = seed
        self._speed = speed
        self._reboot_s = reboot_s
        self._firmware = firmware
        self._labels = Labels(device_map)
        self._memory = Memory(device_map, _serial_extent(device_map, serial_number))
        if serial_number is not None and device_map.identity.serial_first is not None:
            self._memory.store(
                Space.REGISTERS, device_map.identity.serial_first, *_ascii_words(device_map, serial_number)
            )
        self._born: float | None = None
        self._deaf_until = -math.inf
        self._slave_deadline = math.inf
        restore_factory_settings(self._memory, self.plant)
        self._memory.set("modbus_id", address)
        self._log = DailyLog(device_map.log, self._memory, log_order) if device_map.log is not None else None
        self._write_past()
        self._set_constants()
        self.day = SolarDay(
            seed,
            self.plant,
            set_points(self._memory, self.plant),
            self._labels.nature(),
            start_s=start_hour * 3600,
            step_s=step_s,
            totals=self._past_totals(),
        )
        self._stored_at_day = self._hourmeter_day()
        self._copy_stored_to_ram()
        self._publish()
        store_totals(self._memory)
        self._coils: Mapping[str, Callable[[int, float], bool]] = {
            "equalize_triggered": self._trigger_equalize,
            "load_disconnect_forced": self._disconnect_load,
            "charge_disconnect_forced": self._disconnect_charge,
            "clear_charge_resettable": self._when_set(self._clear_charge_resettable),
            "clear_charge_total": self._when_set(self._clear_charge_total),
            "clear_energy_resettable": self._when_set(self._clear_energy_resettable),
            "clear_energy_total": self._when_set(self._clear_energy_total),
            "clear_faults": self._when_set(self._clear_faults),
            "clear_alarms": self._when_set(self._clear_alarms),
            "force_eeprom_update": self._when_set(lambda: store_totals(self._memory)),
            "clear_battery_voltage_extremes": self._when_set(self._clear_extremes),
            "factory_reset": self._factory_reset,
            "reset_control": self._reset,
        }

    @property
    def memory(self) -> Memory:
        """What the registers hold, as of the last request."""
        return self._memory

    def hears(self, now: float) -> bool:
        """See `Controller.hears`."""
        return now >= self._deaf_until

    def identification(self) -> Mapping[int, bytes]:
        """See `Controller.identification`."""
        texts = (self.map.identity.vendor, self.plant.product, f"v01.01.{self._firmware:02d}")
        return {number: text.encode("ascii") for number, text in enumerate(texts)}

    def advance(self, now: float) -> None:
        """Let the unit live until `now`; every request does this by itself."""
        if self._born is None:
            self._born = now - self.day.at_s / self._speed
        changed = False
        if now > self._slave_deadline:
            changed = self.day.advance((self._slave_deadline - self._born) * self._speed)
            self._end_slave_control()
            self.day.orders.array_faults |= self._labels.mask("array_faults", "slave_timeout")
        if self.day.advance((now - self._born) * self._speed) or changed:
            self._publish()

    def read(self, space: Space, first: int, count: int, now: float) -> list[int]:
        """See `Controller.read`."""
        self.advance(now)
        return self._memory.read(space, first, count)

    def write(self, space: Space, address: int, value: int, now: float) -> bool:
        """See `Controller.write`."""
        self.advance(now)
        point = self._memory.point_at(space, address)
        if point is None or not _accepts_writes(point):
            raise missing(space, address)
        if space is Space.COILS:
            action = self._coils.get(point.name)
            answered = action(value, now) if action is not None else True
        else:
            self._memory.store(space, address, value)
            self._register_written(point, now)
            answered = True
        self._publish()
        return answered

    def _register_written(self, point: Point, now: float) -> None:
        if self._memory.in_eeprom(point.space, point.address):
            self._raise_setting_edit()
            self.day.points = set_points(self._memory, self.plant)
            return
        orders = self.day.orders
        if point.name == "battery_target_voltage_slave":
            orders.array_faults &= ~self._labels.mask("array_faults", "slave_timeout")
            orders.slave_v = self._volts(point.name)
            self._slave_deadline = now + _SLAVE_TIMEOUT_S if orders.slave_v > 0 else math.inf
        orders.fixed_array_v = self._volts("array_fixed_voltage")
        orders.fixed_array_share = self._volts("array_fixed_fraction")

    def _raise_setting_edit(self) -> None:
        orders, labels = self.day.orders, self._labels
        by_alarm = self._memory.get("setting_change_signal") == _SIGNAL_BY_ALARM
        if by_alarm and self._firmware >= _FIRST_FIRMWARE_WITH_ALARM:
            orders.alarms |= labels.mask("alarms", "setting_changed")
            return
        orders.array_faults |= labels.mask("array_faults", "eeprom_edited")
        orders.load_faults |= labels.mask("load_faults", "eeprom_edited")

    def _volts(self, name: str) -> float:
        value = self._memory.get(name)
        return float(value) if value is not None and value > 0 else 0.0

    def _end_slave_control(self) -> None:
        self.day.orders.slave_v = 0.0
        self._slave_deadline = math.inf

    @staticmethod
    def _when_set(action: Callable[[], None]) -> Callable[[int, float], bool]:
        def act(value: int, _now: float) -> bool:
            if value:
                action()
            return True

        return act

    def _trigger_equalize(self, value: int, _now: float) -> bool:
        self.day.orders.equalize = value == 1 and self.day.points.equalize_v > 0
        return True

    def _disconnect_load(self, value: int, _now: float) -> bool:
        self.day.orders.load_disconnect = value == 1
        return True

    def _disconnect_charge(self, value: int, _now: float) -> bool:
        self.day.orders.charge_disconnect = value == 1
        return True

    def _clear_charge_resettable(self) -> None:
        self.day.totals.charge_ah_r = self.day.totals.load_ah_r = 0.0

    def _clear_charge_total(self) -> None:
        self.day.totals.charge_ah = self.day.totals.load_ah = 0.0

    def _clear_energy_resettable(self) -> None:
        self.day.totals.charge_kwh_r = 0.0

    def _clear_energy_total(self) -> None:
        self.day.totals.charge_kwh = 0.0

    def _clear_faults(self) -> None:
        orders, labels = self.day.orders, self._labels
        orders.array_faults &= labels.mask("array_faults", "eeprom_edited")
        orders.load_faults &= labels.mask("load_faults", "eeprom_edited")

    def _clear_alarms(self) -> None:
        self.day.orders.alarms &= self._labels.mask("alarms", "setting_changed")

    def _clear_extremes(self) -> None:
        today = self.day.today
        today.battery_min_v = today.battery_max_v = self.day.now.battery_v
        for name in ("battery_voltage_minimum_stored", "battery_voltage_maximum_stored"):
            self._memory.set(name, self.day.now.battery_v)

    def _factory_reset(self, value: int, now: float) -> bool:
        if not value:
            return True
        restore_factory_settings(self._memory, self.plant)
        return self._reset(value, now)

    def _reset(self, value: int, now: float) -> bool:
        if not value:
            return True
        self._deaf_until = now + self._reboot_s
        stored = self._memory.get("modbus_id")
        if stored is not None and 1 <= stored <= _MAX_ADDRESS:
            self.address = int(stored)
        self._end_slave_control()
        orders = self.day.orders
        orders.array_faults = orders.load_faults = 0
        orders.alarms = self._labels.mask("alarms", "reset")
        orders.equalize = orders.load_disconnect = orders.charge_disconnect = False
        self._copy_stored_to_ram()
        self.day.points = set_points(self._memory, self.plant)
        self.day.restart()
        return False

    def _copy_stored_to_ram(self) -> None:
        """Start-up: RAM begins with what EEPROM holds."""
        memory, orders = self._memory, self.day.orders
        memory.set("battery_target_voltage_slave", 0.0)
        orders.fixed_array_v = self._volts("stored_array_fixed_voltage")
        orders.fixed_array_share = self._volts("stored_array_fixed_fraction")
        memory.set("array_fixed_voltage", orders.fixed_array_v)
        memory.set("array_fixed_fraction", orders.fixed_array_share)
        by_alarm = memory.get("stored_setting_change_signal") == _SIGNAL_BY_ALARM
        memory.set("setting_change_signal", _SIGNAL_BY_ALARM if by_alarm else 0)
        for name in ("foldback_full_output_temperature", "foldback_zero_output_temperature"):
            memory.set(name, memory.get(f"stored_{name}") or 0)

    def _set_constants(self) -> None:
        dice = random.Random(f"{self._seed}/supplies")  # noqa: S311  tolerances of parts are no secret
        supplies = {
            "supply_3v3_voltage": 3.3,
            "supply_12v_voltage": 12.1,
            "supply_5v_voltage": 5.02,
            "gate_drive_voltage": 13.6,
            "meterbus_voltage": 11.8,
        }
        for name, volts in supplies.items():
            self._memory.set(name, volts * dice.uniform(0.99, 1.01))
        self._memory.set("software_version", self._firmware)
        self._memory.set("settings_voltage_multiplier", self.plant.multiplier)
        self._memory.set("dip_switches", dice.randrange(0x80))

    def _past_totals(self) -> Totals:
        plant, days = self.plant, self.plant.age_days
        used = days * (24 * plant.base_load_a + 4.5 * plant.lamp_a)
        energy = used * 1.12 * 13.4 * plant.multiplier / 1000
        return Totals(
            charge_ah=used * 1.12,
            charge_ah_r=used * 0.31,
            load_ah=used,
            load_ah_r=used * 0.28,
            charge_kwh=energy,
            charge_kwh_r=energy * 0.28,
            hours=24.0 * days,
        )

    def _write_past(self) -> None:
        if self._log is None:
            return
        first = max(0, self.plant.age_days - _LOG_HISTORY)
        self._log.written = first
        dice = random.Random(f"{self._seed}/log")  # noqa: S311  the past is no secret
        for number in range(first, self.plant.age_days):
            self._log.append(past_day(self.plant, number, dice))

    def _hourmeter_day(self) -> int:
        return int(self.day.totals.hours // 24)

    def _publish(self) -> None:
        self.day.show_faults()
        publish(self.day, self._memory, self._labels)
        if self._log is not None:
            for hours, today in self.day.closed:
                self._log.append(_log_fields(hours, today))
        self.day.closed.clear()
        if self._hourmeter_day() != self._stored_at_day:
            self._stored_at_day = self._hourmeter_day()
            store_totals(self._memory)


def _accepts_writes(point: Point) -> bool:
    return point.access is not Access.READ or point.group is Group.COMMAND


def _log_fields(hours: float, today: Today) -> dict[str, float | int]:
    return {
        "hourmeter": int(hours),
        "alarms": today.alarms,
        "load_faults": today.load_faults,
        "array_faults": today.array_faults,
        "battery_voltage_minimum": today.battery_min_v,
        "battery_voltage_maximum": today.battery_max_v,
        "charge": today.charge_ah,
        "load_charge": today.load_ah,
        "array_voltage_maximum": today.array_max_v,
        "absorption_time": today.absorption_s,
        "equalize_time": today.equalize_s,
        "float_time": today.float_s,
    }


def _serial_extent(device_map: DeviceMap, serial_number: str | None) -> tuple[Extent, ...]:
    first = device_map.identity.serial_first
    if serial_number is None or first is None:
        return ()
    last = first + device_map.identity.serial_words - 1
    return (Extent("serial_number", Space.REGISTERS, first, last, PollClass.BACKGROUND, writable=False, doc="field"),)


def _ascii_words(device_map: DeviceMap, text: str) -> list[int]:
    data = text.encode("ascii").ljust(2 * device_map.identity.serial_words, b"\x00")
    return [int.from_bytes(data[k : k + 2], "big") for k in range(0, 2 * device_map.identity.serial_words, 2)]
