"""What LibreNMS does with an agent that it has no definition for, from what its documentation and sources say.

Discovery walks entPhysicalDescr, entPhysicalName and five columns of entPhySensorTable with MIB names. A row becomes a
sensor when LibreNMS has a class for its type and its value is a number:

- class: voltsDC and voltsAC are voltage, amperes current, watts power, celsius temperature;
- divisor and multiplier follow from the scale's name, and precision adds that many zeros to the divisor;
- the name is entPhysicalName with its words capitalised, entPhysicalDescr when that is empty; of a temperature the
  word "Temperature" is taken out;
- temperatures above 200, values of -127 and rows that are unavailable are left out.

Polling then gets entPhySensorValue by its number, and divides.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

CLASSES = {
    "voltsDC": "voltage",
    "voltsAC": "voltage",
    "amperes": "current",
    "watts": "power",
    "hertz": "frequency",
    "percentRH": "humidity",
    "rpm": "fanspeed",
    "celsius": "temperature",
}
DIVISORS = {"nano": 10**9, "micro": 10**6, "milli": 10**3, "units": 1, "kilo": 1, "mega": 1, "giga": 1}
MULTIPLIERS = {"kilo": 10**3, "mega": 10**6, "giga": 10**9}
COLUMNS = ("entPhySensorType", "entPhySensorScale", "entPhySensorPrecision", "entPhySensorValue")
STATUS = "entPhySensorOperStatus"
NAMES = ("entPhysicalDescr", "entPhysicalName")

_NUMBER = re.compile(r"-?\d+(\.\d+)?")


@dataclass(frozen=True)
class Sensor:
    """What LibreNMS keeps and graphs."""

    kind: str
    name: str
    oid: str
    divisor: int
    multiplier: int
    value: float


def rows(output: str) -> dict[int, dict[str, str]]:
    """Columns by index, of walks as LibreNMS makes them (`-OQUs`: `name.index = value`)."""
    found: dict[int, dict[str, str]] = {}
    for line in output.splitlines():
        match = re.fullmatch(r"(?P<name>\w+)\.(?P<index>\d+) = (?P<value>.*)", line)
        if match:
            found.setdefault(int(match["index"]), {})[match["name"]] = match["value"].strip('"')
    return found


def discover(cells: Mapping[int, Mapping[str, str]]) -> list[Sensor]:
    """The sensors that it makes of the walked cells."""
    found = []
    for index, cell in cells.items():
        kind, text = CLASSES.get(cell.get("entPhySensorType", "")), cell.get("entPhySensorValue", "")
        if kind is None or not _NUMBER.fullmatch(text):
            continue
        scale, precision = cell["entPhySensorScale"], int(cell.get("entPhySensorPrecision", "0"))
        divisor = int(f"{DIVISORS[scale]}{'0' * max(0, precision)}")
        multiplier = MULTIPLIERS.get(scale, 1)
        name = cell["entPhysicalName"] or cell["entPhysicalDescr"]
        name = re.sub(r"(^|\s)(\w)", lambda match: match[1] + match[2].upper(), name)
        value = float(text) * multiplier / divisor
        if kind == "temperature":
            name = re.sub(r"[Tt]emperature", "", name)
        if value == -127 or (kind == "temperature" and value > 200) or cell[STATUS] == "unavailable":
            continue
        found.append(Sensor(kind, name, f".1.3.6.1.2.1.99.1.1.1.4.{index}", divisor, multiplier, value))
    return found
