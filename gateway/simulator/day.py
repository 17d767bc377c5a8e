"""A controller's life: sky, array, battery, load and charge stages stepped together, with counters and the day's log.

Time is virtual seconds since the midnight before the start. The state moves in steps of `step_s` on a fixed
grid, so that it depends on the seed and the orders alone and not on how often somebody asks; after a long
silence the steps grow, so that catching up stays cheap.
"""

from __future__ import annotations

import math
import random
from dataclasses import dataclass, field, replace

from gateway.simulator.charger import CHARGING, Charger, ChargeStage, LoadOutput, LoadStage, Orders, Seen, SetPoints
from gateway.simulator.plant import Battery, Plant, array_curve, load_wanted_a
from gateway.simulator.sky import DAY_S, Sky

_EFFICIENCY = 0.965
_SWEEP_S = 600.0
_HOT_C, _COOL_C = 66.0, 62.0
_HOT_LIMIT = 0.85
_MAX_STEPS = 2_000  # at once; a longer silence is caught up in longer steps
_RTS_GLITCH_SHARE = 0.3  # share of days on which the remote sensor is lost for a while
_RTS_GLITCH_S = 1_200.0


@dataclass(slots=True)
class Today:
    """What is counted from dusk to dusk; faults and alarms are sticky bit fields."""

    battery_min_v: float = 99.0
    battery_max_v: float = 0.0
    charge_ah: float = 0.0
    load_ah: float = 0.0
    array_max_v: float = 0.0
    absorption_s: float = 0.0
    equalize_s: float = 0.0
    float_s: float = 0.0
    array_faults: int = 0
    load_faults: int = 0
    alarms: int = 0
    charge_kwh: float = 0.0
    output_max_w: float = 0.0
    battery_min_c: float = 99.0
    battery_max_c: float = -99.0


@dataclass(slots=True)
class Totals:
    """Counters that only a client clears; `_r` is the resettable twin."""

    charge_ah: float = 0.0
    charge_ah_r: float = 0.0
    load_ah: float = 0.0
    load_ah_r: float = 0.0
    charge_kwh: float = 0.0
    charge_kwh_r: float = 0.0
    hours_before: float = 0.0  # hourmeter at the midnight the unit's time begins with
    service_at_h: float = 0.0  # hourmeter when somebody last looked after the battery
    battery_min_v: float = 99.0  # since the resettable charge was cleared
    battery_max_v: float = 0.0


@dataclass(frozen=True, slots=True)
class Masks:
    """Where in the map's bit fields the causes stand that nature can have."""

    battery_hvd: int  # array fault
    load_hvd: int  # load fault
    heatsink_hot: int  # the others are alarms
    current_limit: int
    rts_lost: int
    lvd: int


@dataclass(slots=True)
class Conditions:
    """What is wrong by nature, not by a client, at this moment."""

    battery_hvd: bool = False
    load_hvd: bool = False
    heatsink_hot: bool = False
    current_limit: bool = False
    rts_lost: bool = False
    lvd: bool = False


@dataclass(slots=True)
class Electrics:
    """Measured values at this moment."""

    battery_v: float = 0.0
    battery_25s_v: float = 0.0
    battery_60s_v: float = 0.0
    net_a: float = 0.0
    net_60s_a: float = 0.0
    charge_a: float = 0.0
    charge_60s_a: float = 0.0
    load_a: float = 0.0
    array_v: float = 0.0
    array_a: float = 0.0
    output_w: float = 0.0
    sweep_vmp_v: float = 0.0
    sweep_pmax_w: float = 0.0
    sweep_voc_v: float = 0.0
    array_target_v: float = 0.0
    ambient_c: float = 20.0
    heatsink_c: float = 20.0
    inductor_c: float = 20.0


@dataclass(slots=True)
class SolarDay:
    """One unit's plant and charger; `advance` moves it, everything else is there to be read."""

    seed: int
    plant: Plant
    points: SetPoints
    masks: Masks
    start_s: float = 9 * 3600.0
    step_s: float = 5.0
    orders: Orders = field(default_factory=Orders)
    now: Electrics = field(default_factory=Electrics)
    today: Today = field(default_factory=Today)
    totals: Totals = field(default_factory=Totals)
    conditions: Conditions = field(default_factory=Conditions)
    closed: list[tuple[float, Today]] = field(default_factory=list)  # hourmeter and day, for the log to take
    array_faults: int = field(init=False, default=0)
    load_faults: int = field(init=False, default=0)
    alarms: int = field(init=False, default=0)
    at_s: float = field(init=False, default=0.0)
    sky: Sky = field(init=False)
    battery: Battery = field(init=False)
    charger: Charger = field(init=False)
    load: LoadOutput = field(init=False)
    _regulated: bool = field(init=False, default=False)
    _usable: bool = field(init=False, default=False)
    _sweep_at_s: float = field(init=False, default=0.0)
    _rts_day: int = field(init=False, default=-1)
    _rts_from_s: float = field(init=False, default=math.inf)
    _kept: Totals = field(init=False)
    _kept_hours: float = field(init=False)

    def __post_init__(self) -> None:
        self.sky = Sky(self.seed, self.plant.warmth_c)
        self.battery = Battery(self.plant)
        self.charger = Charger(self.plant.days_since_equalize)
        self.load = LoadOutput()
        self.charger.stage = ChargeStage.NIGHT
        rest_v = self.battery.rest_v()
        self.now.battery_v = self.now.battery_25s_v = self.now.battery_60s_v = rest_v
        self.now.ambient_c = self.now.heatsink_c = self.now.inductor_c = self.sky.ambient_c(0.0)
        self.advance(self.start_s)
        self.keep()

    @property
    def hours(self) -> float:
        """The hourmeter."""
        return self.totals.hours_before + self.at_s / 3600

    @property
    def battery_c(self) -> float:
        """Temperature the charger compensates with: the remote sensor, or the air."""
        has_sensor = self.plant.has_rts and not self.conditions.rts_lost
        return self.remote_c if has_sensor else self.now.ambient_c

    @property
    def remote_c(self) -> float:
        """What a remote sensor on the battery measures; it lags the air and follows the charge current."""
        return self.sky.ambient_c(self.at_s - 7200.0) + 0.06 * self.now.charge_a

    def keep(self) -> None:
        """Store the counters, as the unit does every 24 hours."""
        self._kept = replace(self.totals)
        self._kept_hours = self.hours

    def restart(self) -> None:
        """Begin the stages again, as after a reset; the counters go on from what was stored last."""
        self.charger.restart()
        self.load.restart()
        self.totals = replace(self._kept, hours_before=self._kept_hours - self.at_s / 3600)

    def advance(self, to_s: float) -> bool:
        """Move to the last grid step not after `to_s`; whether anything changed."""
        steps = int((to_s - self.at_s) / self.step_s + 1e-9)
        if steps <= 0:
            return False
        stride = max(1, math.ceil(steps / _MAX_STEPS))
        while steps > 0:
            taken = min(stride, steps)
            self._step(taken * self.step_s)
            steps -= taken
        return True

    def _step(self, seconds: float) -> None:
        self.at_s += seconds
        now, plant = self.now, self.plant
        sun = self.sky.irradiance(self.at_s)
        now.ambient_c = self.sky.ambient_c(self.at_s)
        curve = array_curve(plant, sun, now.ambient_c)
        self._usable = curve.voc_v > now.battery_v + plant.multiplier
        now.load_a = load_wanted_a(plant, self.at_s) if self.load.connected else 0.0
        available_w = curve.pmax_w
        held_v = 0.0
        if self.orders.fixes_array:
            held_v = self.orders.fixed_array_v or self.orders.fixed_array_fraction * curve.voc_v
            available_w = curve.power_at(held_v)
        charging = self.charger.stage in CHARGING and self._usable
        self._regulated = False
        now.charge_a = self._charge_current(available_w) if charging else 0.0
        now.net_a = now.charge_a - now.load_a
        now.battery_v = self.battery.voltage(now.net_a)
        self.battery.pass_current(now.net_a, seconds)
        now.output_w = now.charge_a * now.battery_v
        if charging:
            array_w = now.output_w / _EFFICIENCY
            now.array_v = held_v or curve.voltage_for(array_w)
            now.array_a = array_w / max(now.array_v, 1.0)
            if self.at_s >= self._sweep_at_s:
                self._sweep_at_s = self.at_s + _SWEEP_S
                now.sweep_voc_v, now.sweep_vmp_v, now.sweep_pmax_w = curve.voc_v, curve.vmp_v, curve.pmax_w
            now.array_target_v = held_v or now.sweep_vmp_v
        else:
            now.array_v, now.array_a, now.array_target_v = curve.voc_v, 0.0, 0.0
        self._filter(seconds)
        self._warm(seconds)
        self._judge()
        self._count(seconds)
        self._decide(seconds)

    def _charge_current(self, available_w: float) -> float:
        """Charge current the regulator lets through; remembers whether it holds its target."""
        points = self.points
        available = available_w * _EFFICIENCY / self.now.battery_v
        limit = min(self.plant.rated_a, points.charge_limit_a, points.battery_limit_a)
        if self.charger.stage is ChargeStage.SLAVE and self.orders.slave_a > 0:
            limit = min(limit, self.orders.slave_a)
        if self.conditions.heatsink_hot:
            limit *= _HOT_LIMIT
        self.conditions.current_limit = available > limit
        ceiling = min(available, limit)
        needed = max(0.0, self.battery.current_at(self.charger.target_v) + self.now.load_a)
        self._regulated = needed <= ceiling
        return min(needed, ceiling)

    def _filter(self, seconds: float) -> None:
        now = self.now
        now.battery_25s_v += (now.battery_v - now.battery_25s_v) * min(1.0, seconds / 25)
        part = min(1.0, seconds / 60)
        now.battery_60s_v += (now.battery_v - now.battery_60s_v) * part
        now.net_60s_a += (now.net_a - now.net_60s_a) * part
        now.charge_60s_a += (now.charge_a - now.charge_60s_a) * part

    def _warm(self, seconds: float) -> None:
        now = self.now
        loss_w = now.output_w * (1 - _EFFICIENCY)
        part = min(1.0, seconds / 900)
        now.heatsink_c += (now.ambient_c + self.plant.heatsink_c_per_w * loss_w - now.heatsink_c) * part
        inductor = now.ambient_c + 0.8 * (now.heatsink_c - now.ambient_c) + 9.0 * now.charge_a / self.plant.rated_a
        now.inductor_c += (inductor - now.inductor_c) * min(1.0, seconds / 300)

    def _judge(self) -> None:
        """Find what is wrong now."""
        now, points, found = self.now, self.points, self.conditions
        found.heatsink_hot = now.heatsink_c > (_COOL_C if found.heatsink_hot else _HOT_C)
        found.current_limit = found.current_limit and now.charge_a > 0 and not self._regulated
        found.battery_hvd = points.hvd_v > 0 and now.battery_v > (points.hvr_v if found.battery_hvd else points.hvd_v)
        found.load_hvd = points.load_hvd_v > 0 and now.battery_v > (
            points.load_hvr_v if found.load_hvd else points.load_hvd_v
        )
        found.lvd = self.load.stage is LoadStage.LVD
        if self.plant.has_rts:
            self._judge_sensor()
        self.show_faults()

    def show_faults(self) -> None:
        """Put what is wrong by nature and what clients caused into the bit fields, now and for today."""
        found, masks, orders, today = self.conditions, self.masks, self.orders, self.today
        self.array_faults = orders.array_faults | (masks.battery_hvd if found.battery_hvd else 0)
        self.load_faults = orders.load_faults | (masks.load_hvd if found.load_hvd else 0)
        self.alarms = (
            orders.alarms
            | (masks.heatsink_hot if found.heatsink_hot else 0)
            | (masks.current_limit if found.current_limit else 0)
            | (masks.rts_lost if found.rts_lost else 0)
            | (masks.lvd if found.lvd else 0)
        )
        today.array_faults |= self.array_faults
        today.load_faults |= self.load_faults
        today.alarms |= self.alarms

    def _judge_sensor(self) -> None:
        day = int(self.at_s // DAY_S)
        if day != self._rts_day:
            self._rts_day = day
            dice = random.Random(f"{self.seed}/rts/{day}")  # noqa: S311  a loose connector is no secret
            glitch = dice.random() < _RTS_GLITCH_SHARE
            self._rts_from_s = day * DAY_S + dice.uniform(8, 17) * 3600 if glitch else math.inf
        self.conditions.rts_lost = 0.0 <= self.at_s - self._rts_from_s < _RTS_GLITCH_S

    def _count(self, seconds: float) -> None:
        now, today, totals = self.now, self.today, self.totals
        hours = seconds / 3600
        charged, used = now.charge_a * hours, now.load_a * hours
        today.charge_ah += charged
        today.load_ah += used
        totals.charge_ah += charged
        totals.charge_ah_r += charged
        totals.load_ah += used
        totals.load_ah_r += used
        energy = now.output_w * hours / 1000
        totals.charge_kwh += energy
        totals.charge_kwh_r += energy
        today.charge_kwh += energy
        today.output_max_w = max(today.output_max_w, now.output_w)
        today.battery_min_c = min(today.battery_min_c, self.battery_c)
        today.battery_max_c = max(today.battery_max_c, self.battery_c)
        totals.battery_min_v = min(totals.battery_min_v, now.battery_v)
        totals.battery_max_v = max(totals.battery_max_v, now.battery_v)
        today.battery_min_v = min(today.battery_min_v, now.battery_v)
        today.battery_max_v = max(today.battery_max_v, now.battery_v)
        today.array_max_v = max(today.array_max_v, now.array_v)
        stage = self.charger.stage
        if stage is ChargeStage.ABSORPTION:
            today.absorption_s += seconds
        elif stage is ChargeStage.FLOAT:
            today.float_s += seconds
        elif stage is ChargeStage.EQUALIZE:
            today.equalize_s += seconds

    def _decide(self, seconds: float) -> None:
        dusks = self.charger.dusks
        seen = Seen(self._usable, self._regulated, self.now.battery_v, self.battery_c, self.array_faults)
        self.charger.advance(seconds, seen, self.points, self.orders)
        self.load.advance(
            seconds,
            battery_v=self.now.battery_v,
            load_a=self.now.load_a,
            load_faults=self.load_faults,
            points=self.points,
            orders=self.orders,
        )
        if self.charger.dusks != dusks:
            self.closed.append((self.hours, self.today))
            self.today = Today()
