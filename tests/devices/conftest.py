"""A map small enough to be wrong in one place at a time."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from gateway.devices.forms import parse_map
from gateway.devices.model import DeviceMap

SMALL = """
model = "small"
title = "A small controller"
document = "nowhere"

[functions]
1 = "coils"
3 = "registers"

[identity]
vendor = "Nobody"
product_prefixes = ["S-"]
product_codes = ["S-1"]

[[extent]]
name = "ram"
first = 0x0000
last = 0x000F
poll = "live"
writable = true
doc = "RAM"

[[extent]]
name = "log"
first = 0x8000
last = 0x80FF
doc = "log"

[[extent]]
name = "coils"
space = "coils"
first = 0x0000
last = 0x000F
poll = "live"
writable = true
doc = "coils"

[[reserved]]
name = "hole"
first = 0x0008
last = 0x0009
doc = "RAM"

[enumeration]
state = [
  { number = 0, name = "off", text = "off" },
  { number = 1, name = "on", text = "on" },
]

[bits]
faults = [
  { number = 0, name = "short", text = "short", severity = "critical" },
  { number = 15, name = "open", text = "open", severity = "warning" },
]

[[point]]
name = "battery_voltage"
address = 0x0000
symbol = "vb"
group = "live"
unit = "V"
codec = "f16"
help = "Battery."
doc = "RAM"
mib = { column = 2, scale = 1000, units = "millivolts", syntax = "Integer32" }
metric = "morningstar_battery_voltage_volts"

[[point]]
name = "energy_total"
address = 0x0002
words = 2
symbol = "e"
group = "energy"
unit = "kWh"
codec = "u32"
order = "hi-lo"
scale = 0.1
help = "Energy."
doc = "RAM"
mib = { column = 2, scale = 10, units = "0.1 kilowatt-hours", syntax = "Unsigned32" }
metric = "morningstar_energy_watthours_total"
metric_scale = 1000
[[point.alternative]]
name = "swapped"
codec = "u32"
order = "lo-hi"
scale = 0.1
evidence = "somebody"

[[point]]
name = "charge_state"
address = 0x0004
symbol = "state"
group = "live"
codec = "enum"
enumeration = "state"
help = "State."
doc = "RAM"
mib = { column = 3, syntax = "Enumeration" }
metric = "morningstar_charge_state"

[[point]]
name = "faults"
address = 0x0005
symbol = "faults"
group = "live"
codec = "bits"
bits = "faults"
conditions = { first = 100, name = "fault" }
help = "Faults."
doc = "RAM"
mib = { column = 4, syntax = "Bits" }
metric = "morningstar_faults"

[[point]]
name = "limit"
address = 0x0006
symbol = "limit"
group = "settings"
unit = "A"
access = "write"
codec = "f16"
minimum = 0
maximum = 40
plausible = [-100, 100]
help = "Limit."
doc = "RAM"

[[point]]
name = "reset"
space = "coils"
address = 0x0000
symbol = "Reset"
group = "command"
access = "set"
codec = "coil"
help = "Reset."
doc = "coils"

[log]
first = 0x8000
blocks = 16
block_words = 16
doc = "log"

[[log.field]]
name = "hourmeter"
symbol = "hourmeter"
offset = 0
words = 2
codec = "u32"
unit = "h"
help = "Hours."

[[log.field]]
name = "voltage"
symbol = "v"
offset = 2
codec = "f16"
unit = "V"
help = "Voltage."
"""


@pytest.fixture(scope="session")
def small_text() -> str:
    return SMALL


@pytest.fixture(scope="session")
def small(small_text: str) -> DeviceMap:
    return parse_map(small_text, "small.toml")


@pytest.fixture(scope="session")
def changed(small_text: str) -> Callable[..., str]:
    """The small map's text with pieces replaced; each piece must be there exactly once."""

    def change(*pieces: tuple[str, str]) -> str:
        text = small_text
        for old, new in pieces:
            assert text.count(old) == 1, f"{old!r} is there {text.count(old)} times"
            text = text.replace(old, new)
        return text

    return change
