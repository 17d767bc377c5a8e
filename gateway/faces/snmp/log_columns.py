"""How the MIB describes the log table: columns from the fields of the maps' logs.

Numbers are append-only (mibs/oids.lock): 1 is the index, 2 and 3 stand here, the others in the maps. Fields of one
name share a column over all models.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable

from gateway.devices.model import DeviceMap, LogField, Value
from gateway.devices.units import UNITS
from gateway.errors import MapError
from gateway.faces.snmp.objects import CellValue, Changes, Convention, Index, ObjectType, Syntax, in_range

WRITTEN, WRITTEN_ERROR = 2, 3

INDEX = Index(1, "pgwLogHourmeter", 0, 2**32 - 1, "Hourmeter of the device when the day was written.")

_COUNTED = frozenset({"s", "h", "d"})


def _elsewhere(_row: object, _now: float) -> CellValue:
    """The cells of this table are in log_table.py."""
    return None


def _column(
    number: int, name: str, syntax: Syntax, description: str, *, units: str = "", convention: Convention | None = None
) -> ObjectType:
    return ObjectType(
        number, name, syntax, description, _elsewhere, units=units, convention=convention, changes=Changes.NEVER
    )


DATE: tuple[ObjectType, ...] = (
    _column(
        WRITTEN,
        "pgwLogWritten",
        Syntax.UNSIGNED32,
        "When the day was written, as estimated: seconds since 1970-01-01 UTC. Not instantiated while it is not known.",
        units="seconds",
    ),
    _column(
        WRITTEN_ERROR,
        "pgwLogWrittenError",
        Syntax.UNSIGNED32,
        "By how much pgwLogWritten may be wrong, either way.",
        units="seconds",
    ),
)


def scale(field: LogField) -> int:
    """What a field's value is multiplied by: the finest that the MIB has for its unit."""
    return max(UNITS[field.unit].mib_units)


def syntax(field: LogField) -> Syntax:
    """The syntax of a field's column."""
    if field.bits is not None:
        return Syntax.BITS
    return Syntax.UNSIGNED32 if field.unit in _COUNTED else Syntax.INTEGER32


def number_of(field: LogField, value: Value | None) -> int | None:
    """A value as the integer of its column (bits as they are); None when it is none or does not fit."""
    if value is None or not math.isfinite(value):
        return None
    if field.bits is not None:
        return int(value) if 0 <= value < 1 << 16 * field.words else None
    number = round(value * scale(field))
    return number if in_range(syntax(field), number) else None


def log_columns(
    maps: Iterable[DeviceMap], name_of: Callable[[str], str], convention_of: Callable[[str, str], Convention]
) -> tuple[ObjectType, ...]:
    """The columns by number; MapError when two models disagree.

    `name_of` gives the descriptor of a field, `convention_of` the convention of a bit table for who asks.
    """
    found = {column.number: column for column in DATE}
    for device_map in maps:
        for field in () if device_map.log is None else device_map.log.fields:
            if field.column is None:
                continue
            where = f"{device_map.model}: log field {field.name}"
            column = _column(
                field.column,
                name_of(f"log_{field.name}"),
                syntax(field),
                field.help,
                units="" if field.bits is not None else UNITS[field.unit].mib_units[scale(field)],
                convention=None if field.bits is None else convention_of(field.bits, where),
            )
            known = found.setdefault(field.column, column)
            for part in ("name", "syntax", "units", "convention"):
                if getattr(known, part) != getattr(column, part):
                    raise MapError(f"{where}: column {field.column} already has another {part}")
    return tuple(found[number] for number in sorted(found))
