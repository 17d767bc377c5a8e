"""Sun, clouds and air temperature of a place, for any moment, from a seed.

Time is seconds since a midnight; day 0 is the first. The same seed gives the same weather in any order of
asking. A day is 12.5 hours of sun; each day draws how cloudy it is, each ten minutes whether a cloud stands
before the sun, and what lies between is interpolated.
"""

from __future__ import annotations

import math
import random

DAY_S = 86_400.0
_SUNRISE_S = 6.0 * 3600
_SUNSET_S = 18.5 * 3600
_KNOT_S = 600.0
_WARMEST_S = 15.0 * 3600
_CLOUDINESS = (0.05, 0.15, 0.3, 0.3, 0.5, 0.8)
_FIRST_DAY_CLOUDINESS = 0.15  # the demo begins with a good day


class Sky:
    """Weather of one site; `warmth_c` is its mean air temperature."""

    def __init__(self, seed: int, warmth_c: float = 22.0) -> None:
        self._seed = seed
        self._warmth_c = warmth_c
        self._day = -1
        self._cloudiness = _FIRST_DAY_CLOUDINESS
        self._offset_c = self._next_offset_c = 0.0
        self._knot = -1
        self._here = self._next = 1.0

    def irradiance(self, at_s: float) -> float:
        """Sunlight on the array, 0 to about 1 (1 is 1000 W/m²)."""
        height = math.sin(math.pi * (at_s % DAY_S - _SUNRISE_S) / (_SUNSET_S - _SUNRISE_S))
        if height <= 0 or not _SUNRISE_S < at_s % DAY_S < _SUNSET_S:
            return 0.0
        knot = int(at_s // _KNOT_S)
        if knot != self._knot:
            self._knot = knot
            self._here, self._next = self._clearness(knot), self._clearness(knot + 1)
        part = at_s / _KNOT_S - knot
        return math.pow(height, 1.2) * (self._here + (self._next - self._here) * part)

    def ambient_c(self, at_s: float) -> float:
        """Air temperature in the shelter."""
        self._select_day(int(at_s // DAY_S))
        part = at_s / DAY_S - self._day
        daily = 7.0 * math.cos(2 * math.pi * (at_s % DAY_S - _WARMEST_S) / DAY_S)
        return self._warmth_c + self._offset_c + (self._next_offset_c - self._offset_c) * part + daily

    def _select_day(self, day: int) -> None:
        if day != self._day:
            self._day = day
            self._cloudiness = _FIRST_DAY_CLOUDINESS if day == 0 else self._dice(day, "clouds").choice(_CLOUDINESS)
            self._offset_c, self._next_offset_c = (self._dice(d, "warmth").uniform(-3.0, 3.0) for d in (day, day + 1))

    def _clearness(self, knot: int) -> float:
        self._select_day(int(knot * _KNOT_S // DAY_S))
        dice = self._dice(knot, "knot")
        if dice.random() < self._cloudiness:
            return dice.uniform(0.2, 0.55)
        return dice.uniform(0.88, 1.0)

    def _dice(self, number: int, kind: str) -> random.Random:
        return random.Random(f"{self._seed}/{kind}/{number}")  # noqa: S311  weather is no secret
