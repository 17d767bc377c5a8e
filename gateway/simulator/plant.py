"""What the controllers are bolted to: array, battery and load as simple electric models.

The models are good enough that the numbers of a day hang together (power = voltage × current, a full battery takes
less, a loaded one sags), and cheap enough to step a day in well under a second. Voltages are those of
the whole battery, 12 V, 24 V or 48 V nominal.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from gateway.devices.model import DeviceMap

_DARK = 0.002  # below this share of full sun an array gives no usable voltage


@dataclass(frozen=True, slots=True)
class Plant:
    """One installation: ratings of the controller and of what hangs on it."""

    product: str
    nominal_v: int  # 12, 24 or 48
    rated_a: float  # charge current of the model
    array_w: float
    array_voc_v: float
    battery_ah: float
    soc_at_start: float  # state of charge, 0..1, at the midnight before the start
    base_load_a: float
    lamp_a: float  # on from dusk to 23 h
    has_rts: bool
    warmth_c: float
    heatsink_c_per_w: float
    days_since_equalize: int
    age_days: int  # since it was installed; the daily log has at most so many blocks

    @property
    def multiplier(self) -> int:
        """1 for 12 V, 2 for 24 V, 4 for 48 V: what the 12 V settings are multiplied by."""
        return self.nominal_v // 12

    @property
    def has_phase_w(self) -> bool:
        """Only the 40 A models have a third inductor."""
        return "-40" in self.product


PLANTS = (
    Plant(
        product="PS-MPPT-25M",
        nominal_v=12,
        rated_a=25.0,
        array_w=400.0,
        array_voc_v=43.0,
        battery_ah=220.0,
        soc_at_start=0.8,
        base_load_a=3.2,
        lamp_a=4.5,
        has_rts=False,
        warmth_c=24.0,
        heatsink_c_per_w=4.2,
        days_since_equalize=12,
        age_days=400,
    ),
    Plant(
        product="PS-MPPT-40M",
        nominal_v=24,
        rated_a=40.0,
        array_w=1_150.0,
        array_voc_v=88.0,
        battery_ah=330.0,
        soc_at_start=0.78,
        base_load_a=6.5,
        lamp_a=3.0,
        has_rts=True,
        warmth_c=21.0,
        heatsink_c_per_w=1.0,
        days_since_equalize=27,
        age_days=900,
    ),
    Plant(
        product="PS-MPPT-25",
        nominal_v=12,
        rated_a=25.0,
        array_w=330.0,
        array_voc_v=21.5,
        battery_ah=150.0,
        soc_at_start=0.3,
        base_load_a=3.3,
        lamp_a=6.5,
        has_rts=False,
        warmth_c=27.0,
        heatsink_c_per_w=2.6,
        days_since_equalize=3,
        age_days=37,
    ),
    Plant(
        product="TS-MPPT-45",
        nominal_v=24,
        rated_a=45.0,
        array_w=1_200.0,
        array_voc_v=112.0,
        battery_ah=380.0,
        soc_at_start=0.66,
        base_load_a=7.5,
        lamp_a=5.0,
        has_rts=False,
        warmth_c=25.0,
        heatsink_c_per_w=0.8,
        days_since_equalize=20,
        age_days=210,
    ),
    Plant(
        product="TS-MPPT-60",
        nominal_v=48,
        rated_a=60.0,
        array_w=2_900.0,
        array_voc_v=128.0,
        battery_ah=400.0,
        soc_at_start=0.72,
        base_load_a=9.5,
        lamp_a=4.0,
        has_rts=True,
        warmth_c=22.0,
        heatsink_c_per_w=0.35,
        days_since_equalize=9,
        age_days=1_300,
    ),
)
"""Unlike installations. ProStars: a healthy 12 V one, a big 24 V one due for equalization, a tight one that meets LVD;
TriStars, whose loads hang on the battery and not on them: a 24 V one without a remote sensor and a 48 V one.
"""


def plants_of(device_map: DeviceMap) -> tuple[Plant, ...]:
    """The installations that a model can be bolted to: those above, else the one that its map tells of."""
    named = tuple(plant for plant in PLANTS if device_map.identity.names(plant.product))
    return named or (_plant_of(device_map),)


def _plant_of(device_map: DeviceMap) -> Plant:
    """A 12 V installation for a model that is only a map: as large as its charge counter may grow quickly."""
    identity = device_map.identity
    rates = [rule.per_hour for rule in identity.growing if rule.point == "charge_total"]
    rated_a = float(rates[0]) if rates else 20.0
    return Plant(
        product=next(iter((*identity.product_codes, *identity.product_prefixes, device_map.model))),
        nominal_v=12,
        rated_a=rated_a,
        array_w=14.0 * rated_a,
        array_voc_v=43.0,
        battery_ah=9.0 * rated_a,
        soc_at_start=0.75,
        base_load_a=0.12 * rated_a,
        lamp_a=0.1 * rated_a,
        has_rts=False,
        warmth_c=24.0,
        heatsink_c_per_w=50.0 / (14.0 * rated_a),
        days_since_equalize=10,
        age_days=200,
    )


@dataclass(frozen=True, slots=True)
class ArrayCurve:
    """What the array could do at one moment."""

    voc_v: float
    vmp_v: float
    pmax_w: float

    def power_at(self, volts: float) -> float:
        """Power when the array is held at that voltage."""
        if volts <= 0 or volts >= self.voc_v:
            return 0.0
        if volts <= self.vmp_v:
            return self.pmax_w * volts / self.vmp_v
        return self.pmax_w * (1 - ((volts - self.vmp_v) / (self.voc_v - self.vmp_v)) ** 2)

    def voltage_for(self, watts: float) -> float:
        """Voltage above the maximum power point at which the array gives just `watts`."""
        if self.pmax_w <= 0:
            return self.voc_v
        share = min(1.0, watts / self.pmax_w)
        return self.vmp_v + (self.voc_v - self.vmp_v) * math.sqrt(1 - share)


def array_curve(plant: Plant, sun: float, ambient_c: float) -> ArrayCurve:
    """The array under `sun` (0..1): warm cells give less voltage, little light a little less."""
    if sun <= _DARK:
        return ArrayCurve(0.4, 0.3, 0.0)
    cell_c = ambient_c + 25.0 * sun - 25.0
    voc = plant.array_voc_v * (1 + 0.04 * math.log(sun)) * (1 - 0.003 * cell_c)
    return ArrayCurve(voc, 0.81 * voc, plant.array_w * sun * (1 - 0.004 * cell_c))


class Battery:
    """A lead-acid battery: state of charge, and the terminal voltage that follows from the current."""

    def __init__(self, plant: Plant) -> None:
        self._multiplier = plant.multiplier
        self._capacity_ah = plant.battery_ah
        self._size = plant.multiplier * 200.0 / plant.battery_ah
        self.soc = plant.soc_at_start

    def rest_v(self) -> float:
        """Voltage without current."""
        return self._multiplier * (11.5 + 1.3 * self.soc)

    def voltage(self, net_a: float) -> float:
        """Terminal voltage at a net current (charging is positive)."""
        return self.rest_v() + net_a * (self._charge_ohm() if net_a > 0 else self._discharge_ohm())

    def current_at(self, volts: float) -> float:
        """Net current that holds the terminals at `volts`."""
        above = volts - self.rest_v()
        return above / (self._charge_ohm() if above > 0 else self._discharge_ohm())

    def pass_current(self, net_a: float, seconds: float) -> None:
        """Charge or discharge; nearly full, most of the current only makes gas."""
        efficiency = 1 - 0.97 * self.soc**40 if net_a > 0 else 1.0
        change = net_a * efficiency * seconds / 3600 / self._capacity_ah
        self.soc = min(1.0, max(0.02, self.soc + change))

    def _charge_ohm(self) -> float:
        return self._size * (0.03 + 0.75 * self.soc**20)

    def _discharge_ohm(self) -> float:
        return self._size * (0.02 + 0.12 * (1 - self.soc) ** 3)


def load_wanted_a(plant: Plant, at_s: float) -> float:
    """Current the load draws when it is connected: equipment that is never quite still, and a lamp in the evening."""
    hour = at_s % 86_400.0 / 3600
    lamp = plant.lamp_a if 18.25 <= hour < 23 else 0.0
    return lamp + plant.base_load_a * (1 + 0.12 * math.sin(at_s / 97) + 0.08 * math.sin(at_s / 1310))
