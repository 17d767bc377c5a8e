"""The charge stages and the load output: what the controller decides from voltages, times and set points.

Rules, with the document's own words for the set points:

1. Bulk (MPPT) until the regulation voltage holds, then absorption for Et_float seconds (Et_floatlb after a night
   below EV_floatlb_trip), then float, unless the night went below EV_float_cancel or EV_float is 0.
2. Float ends when the battery was below it for Et_float_exit_cum seconds in total.
3. Equalize takes the place of absorption when Et_eqcalendar days passed or a client triggered it, and ends
   after Et_eq_reg seconds at EV_eq or Et_eq_above seconds above EV_reg.
4. Slave voltage or current overrides the stages; a fixed array voltage replaces bulk by FIXED.
5. A fault or a disconnect order stops charging at once. Night begins after five minutes without usable array voltage.
6. Voltage set points are for 12 V and multiplied; charge set points move with the battery's temperature from 25 °C.
7. The load goes off below LVD (lowered by its own current) after the warning time and comes back at LVR.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

_CHECK_S = 300.0
_START_S = 10.0
_HYSTERESIS_V = 0.3  # for 12 V: absorption falls back to bulk this far below its target


class ChargeStage(StrEnum):
    """Labels of the charge state in the map."""

    START = "start"
    NIGHT_CHECK = "night_check"
    DISCONNECT = "disconnect"
    NIGHT = "night"
    FAULT = "fault"
    MPPT = "mppt"
    ABSORPTION = "absorption"
    FLOAT = "float"
    EQUALIZE = "equalize"
    SLAVE = "slave"
    FIXED = "fixed"


class LoadStage(StrEnum):
    """Labels of the load state in the map."""

    START = "start"
    LOAD_ON = "load_on"
    LVD_WARNING = "lvd_warning"
    LVD = "lvd"
    FAULT = "fault"
    DISCONNECT = "disconnect"
    LOAD_OFF = "load_off"
    OVERRIDE = "override"


CHARGING = frozenset(
    {
        ChargeStage.MPPT,
        ChargeStage.ABSORPTION,
        ChargeStage.FLOAT,
        ChargeStage.EQUALIZE,
        ChargeStage.SLAVE,
        ChargeStage.FIXED,
    }
)
_NIGHTLY = frozenset({ChargeStage.NIGHT, ChargeStage.NIGHT_CHECK})
_BULK = frozenset({ChargeStage.MPPT, ChargeStage.FIXED})


@dataclass(frozen=True, slots=True)
class SetPoints:
    """The EEPROM settings in use; volts already multiplied to the battery's nominal voltage."""

    multiplier: int
    regulation_v: float
    float_v: float
    float_after_s: float
    float_after_low_s: float
    float_low_trip_v: float
    float_cancel_v: float
    float_exit_s: float
    equalize_v: float
    equalize_days: float
    equalize_above_s: float
    equalize_at_s: float
    reference_limit_v: float  # 0: none
    tempcomp_v: float  # V/°C
    tempcomp_max_c: float
    tempcomp_min_c: float
    hvd_v: float  # 0: none
    hvr_v: float
    charge_limit_a: float
    battery_limit_a: float
    lvd_v: float
    lvr_v: float
    load_hvd_v: float  # 0: none
    load_hvr_v: float
    lvd_ohm: float
    lvd_warning_s: float
    led_limits_v: tuple[float, float, float, float]  # green … blinking red


@dataclass(slots=True)
class Orders:
    """What clients and faults make the controller do now; faults and alarms are bit fields of the map."""

    array_faults: int = 0
    load_faults: int = 0
    alarms: int = 0
    charge_disconnect: bool = False
    load_disconnect: bool = False
    equalize: bool = False
    slave_v: float = 0.0
    slave_a: float = 0.0
    fixed_array_v: float = 0.0
    fixed_array_fraction: float = 0.0

    @property
    def slaved(self) -> bool:
        """Whether a voltage or a current was given over Modbus."""
        return self.slave_v > 0 or self.slave_a > 0

    @property
    def fixes_array(self) -> bool:
        """Whether the array voltage is given and not tracked."""
        return self.fixed_array_v > 0 or self.fixed_array_fraction > 0


@dataclass(frozen=True, slots=True)
class Seen:
    """What the charger measures."""

    usable: bool  # array voltage
    regulated: bool  # the target voltage is held
    battery_v: float
    battery_c: float
    array_faults: int


class Charger:
    """The stage, its timers and the voltage it regulates to (0 when it does not charge)."""

    def __init__(self, days_since_equalize: int) -> None:
        self.stage = ChargeStage.START
        self.target_v = 0.0
        self.days_since_equalize = days_since_equalize
        self.night_min_v = 99.0
        self.dusks = 0
        self._day_seen = False
        self._in_stage_s = 0.0
        self._dark_s = self._lit_s = 0.0
        self._absorption_s = self._float_low_s = 0.0
        self._equalize_s = self._above_s = 0.0

    def restart(self) -> None:
        """Begin again as after a reset; the calendar is kept."""
        self._enter(ChargeStage.START)
        self._absorption_s = self._float_low_s = self._equalize_s = self._above_s = 0.0

    def advance(self, seconds: float, seen: Seen, points: SetPoints, orders: Orders) -> None:
        """Pass time under these measurements."""
        self._in_stage_s += seconds
        if self.stage in _NIGHTLY:
            self.night_min_v = min(self.night_min_v, seen.battery_v)
        forced = self._forced(seen, orders)
        if forced is not None:
            if forced is not self.stage:
                self._enter(forced)
        elif self.stage in _NIGHTLY or not seen.usable:
            self._night(seconds, seen)
        elif self.stage not in CHARGING:
            if self.stage is not ChargeStage.START or self._in_stage_s >= _START_S:
                self._enter(ChargeStage.MPPT)
        else:
            self._charge(seconds, seen, points, orders)
        self.target_v = self._target(seen.battery_c, points, orders)

    def _enter(self, stage: ChargeStage) -> None:
        self.stage = stage
        self._in_stage_s = self._dark_s = self._lit_s = 0.0

    @staticmethod
    def _forced(seen: Seen, orders: Orders) -> ChargeStage | None:
        if seen.array_faults:
            return ChargeStage.FAULT
        if orders.charge_disconnect:
            return ChargeStage.DISCONNECT
        if orders.slaved and seen.usable:
            return ChargeStage.SLAVE
        return None

    def _night(self, seconds: float, seen: Seen) -> None:
        if self.stage is not ChargeStage.NIGHT_CHECK:
            if self.stage is not ChargeStage.NIGHT or seen.usable:
                self._enter(ChargeStage.NIGHT_CHECK)
            return
        self._lit_s = self._lit_s + seconds if seen.usable else 0.0
        self._dark_s = 0.0 if seen.usable else self._dark_s + seconds
        if self._dark_s >= _CHECK_S:
            self._enter(ChargeStage.NIGHT)
            if self._day_seen:
                self._end_day()
        elif self._lit_s >= _CHECK_S:
            self._day_seen = True
            self._enter(ChargeStage.MPPT)

    def _end_day(self) -> None:
        """Reset the day's timers, count the equalize calendar, begin a new night minimum."""
        self._day_seen = False
        self.dusks += 1
        self.days_since_equalize += 1
        self._absorption_s = self._float_low_s = self._equalize_s = self._above_s = 0.0
        self.night_min_v = 99.0

    def _charge(self, seconds: float, seen: Seen, points: SetPoints, orders: Orders) -> None:
        equalize = points.equalize_v > 0 and (
            orders.equalize or (points.equalize_days > 0 and self.days_since_equalize >= points.equalize_days)
        )
        if self.stage is ChargeStage.SLAVE:
            self._enter(ChargeStage.MPPT)
        if self.stage in _BULK:
            self.stage = ChargeStage.FIXED if orders.fixes_array else ChargeStage.MPPT
            if seen.regulated:
                self._enter(ChargeStage.EQUALIZE if equalize else ChargeStage.ABSORPTION)
        elif self.stage is ChargeStage.ABSORPTION:
            if equalize:
                self._enter(ChargeStage.EQUALIZE)
            else:
                self._absorb(seconds, seen, points)
        elif self.stage is ChargeStage.FLOAT:
            self._float_low_s += 0.0 if seen.regulated else seconds
            if equalize or self._float_low_s >= points.float_exit_s:
                self._absorption_s = self._float_low_s = 0.0
                self._enter(ChargeStage.MPPT)
        elif self.stage is ChargeStage.EQUALIZE:
            self._equalize_s += seconds if seen.regulated else 0.0
            self._above_s += seconds if seen.battery_v > points.regulation_v else 0.0
            if not equalize or self._equalize_s >= points.equalize_at_s or self._above_s >= points.equalize_above_s:
                self.days_since_equalize = 0 if equalize else self.days_since_equalize
                orders.equalize = False
                self._equalize_s = self._above_s = 0.0
                self._enter(ChargeStage.FLOAT if points.float_v > 0 else ChargeStage.ABSORPTION)

    def _absorb(self, seconds: float, seen: Seen, points: SetPoints) -> None:
        if not seen.regulated and seen.battery_v < self.target_v - _HYSTERESIS_V * points.multiplier:
            self._enter(ChargeStage.MPPT)
            return
        self._absorption_s += seconds if seen.regulated else 0.0
        low = self.night_min_v < points.float_low_trip_v
        enough = points.float_after_low_s if low else points.float_after_s
        cancelled = self.night_min_v < points.float_cancel_v
        if self._absorption_s >= enough and points.float_v > 0 and not cancelled:
            self._enter(ChargeStage.FLOAT)

    def _target(self, battery_c: float, points: SetPoints, orders: Orders) -> float:
        if self.stage not in CHARGING:
            return 0.0
        if self.stage is ChargeStage.SLAVE and orders.slave_v > 0:
            wanted = orders.slave_v
        else:
            at_25 = {ChargeStage.FLOAT: points.float_v, ChargeStage.EQUALIZE: points.equalize_v}
            clamped = min(max(battery_c, points.tempcomp_min_c), points.tempcomp_max_c)
            shift = points.tempcomp_v * (clamped - 25.0) * points.multiplier
            wanted = at_25.get(self.stage, points.regulation_v) - shift
        return min(wanted, points.reference_limit_v) if points.reference_limit_v > 0 else wanted


class LoadOutput:
    """The load's stage; `connected` says whether current flows."""

    def __init__(self) -> None:
        self.stage = LoadStage.START
        self._warned_s = 0.0

    @property
    def connected(self) -> bool:
        """Whether the load has current."""
        return self.stage in {LoadStage.LOAD_ON, LoadStage.LVD_WARNING}

    def restart(self) -> None:
        """Begin again as after a reset."""
        self.stage = LoadStage.START
        self._warned_s = 0.0

    def advance(
        self,
        seconds: float,
        *,
        battery_v: float,
        load_a: float,
        load_faults: int,
        points: SetPoints,
        orders: Orders,
    ) -> None:
        """Pass time at that battery voltage and load current."""
        if load_faults:
            self.stage = LoadStage.FAULT
        elif orders.load_disconnect:
            self.stage = LoadStage.DISCONNECT
        elif self.stage is LoadStage.LVD:
            if battery_v >= points.lvr_v:
                self.stage = LoadStage.LOAD_ON
        elif battery_v < self.lvd_v(load_a, points):
            self._warned_s = self._warned_s + seconds if self.stage is LoadStage.LVD_WARNING else 0.0
            self.stage = LoadStage.LVD if self._warned_s >= points.lvd_warning_s else LoadStage.LVD_WARNING
        else:
            self.stage = LoadStage.LOAD_ON

    @staticmethod
    def lvd_v(load_a: float, points: SetPoints) -> float:
        """The disconnect voltage, lowered in proportion to the load current."""
        return points.lvd_v - points.lvd_ohm * load_a
