"""A simulated controller: registers that follow a plausible day, and writes with the document's consequences.

Registers move with virtual time, `speed` times as fast as the line's; a reboot and the slave time-out last by
the line's time. A unit that reboots answers nothing for `reboot_s`; then it listens to the address its EEPROM holds.
"""

from __future__ import annotations

import math
import random
from collections.abc import Mapping

from gateway.devices.model import DeviceMap, Extent, PollClass, Space, WordOrder
from gateway.devices.texts import encode_text
from gateway.simulator.commands import Commands, accepts_writes
from gateway.simulator.daily_log import DailyLog, fields_of, past_totals
from gateway.simulator.day import SolarDay
from gateway.simulator.factory import FACTORY_ADDRESS, restore_factory_settings, set_points
from gateway.simulator.memory import Memory
from gateway.simulator.panel import Labels, publish, store_totals
from gateway.simulator.plant import Plant, plants_of
from gateway.simulator.server import Controller, missing
from gateway.simulator.sky import DAY_S

DEFAULT_TURNAROUND_S = 0.015

_MAX_ADDRESS = 247


class SimulatedController(Controller):
    """One unit on a line; `plant` is what it is bolted to, by default one of its model's chosen by the seed.

    `serial_number` is one of its own by default; where the model's document knows none, it adds the undocumented
    registers. `log_order` is the word order of the daily log.
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
        plants = plants_of(device_map)
        self.plant = plant or plants[seed % len(plants)]
        self._seed = seed
        self._speed = speed
        self._reboot_s = reboot_s
        self._firmware = firmware
        self._labels = Labels(device_map)
        self._memory = Memory(device_map, _serial_extent(device_map, serial_number), self.plant.product)
        self._set_scaling()
        self._born: float | None = None
        self._outdated = True
        self._deaf_until = -math.inf
        restore_factory_settings(self._memory, self.plant)
        self._memory.set("modbus_id", address)
        self._set_identity(serial_number)
        self._log = self._start_log(log_order)
        self._set_constants()
        self.day = SolarDay(
            seed,
            self.plant,
            set_points(self._memory, self.plant),
            self._labels.nature(),
            start_s=start_hour * 3600,
            step_s=step_s,
            totals=past_totals(self.plant),
        )
        self._commands = Commands(self._memory, self.day, self._labels, firmware)
        self._commands.boot()
        self._publish()
        store_totals(self.day, self._memory)

    @property
    def memory(self) -> Memory:
        """What the registers hold at the time the unit last lived to."""
        self._refresh()
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
        if now > self._commands.slave_deadline:
            self._live_until((self._commands.slave_deadline - self._born) * self._speed)
            self._commands.slave_timed_out()
            self._outdated = True
        self._live_until((now - self._born) * self._speed)

    def read(self, space: Space, first: int, count: int, now: float) -> list[int]:
        """See `Controller.read`."""
        self.advance(now)
        self._refresh()
        return self._memory.read(space, first, count)

    def write(self, space: Space, address: int, value: int, now: float) -> bool:
        """See `Controller.write`."""
        self.advance(now)
        self._refresh()
        point = self._memory.point_at(space, address)
        if point is None or not accepts_writes(point):
            raise missing(space, address)
        answered = True
        if space is Space.COILS:
            answered = self._commands.write_coil(point, value)
        else:
            self._commands.write_register(point, address, value, now)
        if not answered:
            self._reboot(now)
        self._publish()
        return answered

    def _reboot(self, now: float) -> None:
        self._deaf_until = now + self._reboot_s
        stored = self._memory.get("modbus_id")
        if stored is not None and 1 <= stored <= _MAX_ADDRESS:
            self.address = int(stored)

    def _set_constants(self) -> None:
        dice = random.Random(f"{self._seed}/supplies")  # noqa: S311  tolerances of parts are no secret
        supplies = {
            "supply_3v3_voltage": 3.3,
            "supply_12v_voltage": 12.1,
            "supply_5v_voltage": 5.02,
            "gate_drive_voltage": 13.6,
            "meterbus_voltage": 11.8,
            "supply_3v_voltage": 3.3,
            "supply_1v8_voltage": 1.8,
            "reference_voltage": 2.5,
        }
        for name, volts in supplies.items():
            self._memory.set(name, volts * dice.uniform(0.99, 1.01))
        self._memory.set("software_version", self._firmware)
        self._memory.set("settings_voltage_multiplier", self.plant.multiplier)
        self._memory.set("dip_switches", dice.randrange(0x80))
        self._set_network()

    def _set_scaling(self) -> None:
        """What a unit that tells its own scaling tells; the parts have tolerances."""
        dice = random.Random(f"{self._seed}/scaling")  # noqa: S311  tolerances of parts are no secret
        self._memory.set("voltage_scaling", 180.0 * dice.uniform(0.995, 1.005))
        self._memory.set("current_scaling", 80.0 * dice.uniform(0.995, 1.005))

    def _set_identity(self, serial_number: str | None) -> None:
        rules = self.map.identity
        if serial_number is None and self._memory.has("serial_number"):
            serial_number = f"1647{self._seed % 10_000:04d}"
        if serial_number is not None and rules.serial_first is not None:
            words = encode_text("ascii", serial_number, rules.serial_words, rules.serial_order)
            self._memory.store(Space.REGISTERS, rules.serial_first, *words)
        self._memory.set_text("hardware_version", "1.1")
        if self.plant.product in rules.product_codes:
            self._memory.set("controller_model", rules.product_codes.index(self.plant.product))

    def _set_network(self) -> None:
        """The network registers of a unit that has them, as it leaves the factory on a network without DHCP."""
        memory, host = self._memory, 1 + self._seed % 250
        for name, text in {
            "ip_address": f"192.168.1.{host}",
            "subnet_mask": "255.255.255.0",
            "gateway_address": "192.168.1.1",
            "dns_primary_address": "192.168.1.1",
            "dns_secondary_address": "192.168.1.1",
            "controller_id": "TriStar MPPT",
            "mac_address": f"02:4d:53:00:00:{host:02x}",
            "netbios_name": f"tsmppt1647{self._seed % 10_000:04d}",
        }.items():
            memory.set_text(name, text)
        for name, value in {
            "network_firmware_version": 8,
            "network_flags": 0x4000,
            "http_port": 80,
            "modbus_tcp_port": 502,
            "network_rules": 0,
            "snmp_trap_port": 162,
            "ethernet_power_save": 0,
            "vlan_enable": 0,
            "vlan_parameters": 1,
        }.items():
            memory.set(name, value)

    def _start_log(self, order: WordOrder) -> DailyLog | None:
        if self.map.log is None:
            return None
        daily_log = DailyLog(self.map.log, self._memory, order)
        daily_log.fill_past(self.plant, random.Random(f"{self._seed}/log"))  # noqa: S311  the past is no secret
        return daily_log

    def _live_until(self, at_s: float) -> None:
        """Move the day, and store the totals at each midnight on the way."""
        for number in range(int(self.day.at_s // DAY_S) + 1, int(at_s // DAY_S) + 1):
            self.day.advance(number * DAY_S)
            self._publish()
            store_totals(self.day, self._memory)
        self._outdated |= self.day.advance(at_s)

    def _refresh(self) -> None:
        """Bring the registers up to date; writing all of them costs more than a step of the day, so only when asked."""
        if self._outdated:
            self._publish()

    def _publish(self) -> None:
        self._outdated = False
        self.day.show_faults()
        publish(self.day, self._memory, self._labels)
        if self._log is not None:
            for hours, today in self.day.closed:
                self._log.append(fields_of(hours, today))
        self.day.closed.clear()


def _serial_extent(device_map: DeviceMap, serial_number: str | None) -> tuple[Extent, ...]:
    first = device_map.identity.serial_first
    if serial_number is None or first is None or device_map.covers(Space.REGISTERS, first, first + 1):
        return ()
    last = first + device_map.identity.serial_words - 1
    return (Extent("serial_number", Space.REGISTERS, first, last, PollClass.BACKGROUND, writable=False, doc="field"),)
