"""A unit's past: its counters, and the daily log as it keeps it, blocks in a ring, the newest over the oldest.

The order of the words in a 32-bit field is an option: high word first by the document, low word first
as seen on units in the field. A unit younger than the ring has empty blocks: erased, and the one that will be
written next already cleared.
"""

from __future__ import annotations

import random
from collections.abc import Mapping

from gateway.devices.codecs import encode
from gateway.devices.model import LogLayout, Space, Value, WordOrder
from gateway.simulator.day import Today, Totals
from gateway.simulator.memory import ERASED, Memory
from gateway.simulator.plant import Plant

_DUSK_H = 18.7


class DailyLog:
    """Writer of the log blocks in a unit's memory; `written` counts the days since the unit was new."""

    def __init__(self, layout: LogLayout, memory: Memory, order: WordOrder) -> None:
        self._layout = layout
        self._memory = memory
        self._order = order
        self.written = 0
        memory.store(Space.REGISTERS, layout.first, *[ERASED] * (layout.blocks * layout.block_words))

    def append(self, fields: Mapping[str, Value]) -> None:
        """Write one day; every field of the layout, in its base unit."""
        layout = self._layout
        words = [0] * layout.block_words
        for field in layout.fields:
            encoded = encode(field.codec, fields[field.name], field.words, self._order, field.scale)
            words[field.offset : field.offset + field.words] = encoded
        self._put(self.written, words)
        self.written += 1
        if self.written < layout.blocks:
            self._put(self.written, [0] * layout.block_words)

    def fill_past(self, plant: Plant, dice: random.Random) -> None:
        """Write the days since the unit was installed, as many as the ring holds."""
        self.written = max(0, plant.age_days - self._layout.blocks)
        for number in range(self.written, plant.age_days):
            self.append(_past_day(plant, number, dice))

    def _put(self, number: int, words: list[int]) -> None:
        first = self._layout.first + number % self._layout.blocks * self._layout.block_words
        self._memory.store(Space.REGISTERS, first, *words)


def fields_of(hours: float, today: Today) -> dict[str, Value]:
    """The log fields of a day that ended at that hourmeter."""
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


def past_totals(plant: Plant) -> Totals:
    """Counters of a unit of that age: what the load took, and a little more from the array."""
    used = plant.age_days * (24 * plant.base_load_a + 4.5 * plant.lamp_a)
    energy = used * 1.12 * 13.4 * plant.multiplier / 1000
    return Totals(
        charge_ah=used * 1.12,
        charge_ah_r=used * 0.31,
        load_ah=used,
        load_ah_r=used * 0.28,
        charge_kwh=energy,
        charge_kwh_r=energy * 0.28,
        hours_before=24.0 * plant.age_days,
        service_at_h=24.0 * (plant.age_days - plant.age_days % 180),
    )


def _past_day(plant: Plant, number: int, dice: random.Random) -> dict[str, Value]:
    """A plausible day of the unit's past; `number` 0 is the day it was installed."""
    sunny = dice.random() < 0.75
    lowest = plant.multiplier * dice.uniform(11.95, 12.35)
    used = 24 * plant.base_load_a + 4.5 * plant.lamp_a * dice.uniform(0.8, 1.0)
    return {
        "hourmeter": int(24 * number + _DUSK_H),
        "alarms": 0,
        "load_faults": 0,
        "array_faults": 0,
        "battery_voltage_minimum": lowest,
        "battery_voltage_maximum": plant.multiplier
        * (dice.uniform(14.35, 14.5) if sunny else dice.uniform(13.2, 14.2)),
        "charge": used * (dice.uniform(1.0, 1.15) if sunny else dice.uniform(0.5, 0.9)),
        "load_charge": used,
        "array_voltage_maximum": plant.array_voc_v * dice.uniform(0.94, 1.02),
        "absorption_time": 60 * (dice.randint(150, 185) if sunny else dice.randint(0, 30)),
        "equalize_time": 0,
        "float_time": 60 * dice.randint(60, 240) if sunny else 0,
    }
