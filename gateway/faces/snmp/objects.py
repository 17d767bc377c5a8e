"""What an object of the MIB is: the words in which `layout.py` describes the whole of it.

Rules:

1. One description serves both sides. The agent takes number, syntax and `get` from it, the MIB generator
   number, name, syntax, units and description, so a leaf cannot be served and not described, or the reverse.
2. `get` returns a plain Python value (`int`, `bytes` or a tuple of arcs) or None. None means "this cell is not
   instantiated now"; there is no other way to say "no value".
3. An integer outside the range of its syntax is no value. Only Counter32 and TimeTicks wrap, as RFC 2578 says.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import Enum, StrEnum
from typing import Any, NamedTuple

from gateway.core.conditions import Conditions, DeviceConditions, Watch
from gateway.core.site import Device, LinePort, Site
from gateway.core.stats import ModbusServerStats
from gateway.devices.model import Point, Value
from gateway.faces.snmp.client_rows import ClientRows
from gateway.faces.snmp.counters import SnmpCounters
from gateway.faces.snmp.settings import Oid

CellValue = int | bytes | Oid | None
"""The value of a cell; None: not instantiated."""


class Syntax(StrEnum):
    """SYNTAX of an object, by the name it has in a MIB module."""

    INTEGER32 = "Integer32"
    UNSIGNED32 = "Unsigned32"
    GAUGE32 = "Gauge32"
    COUNTER32 = "Counter32"
    TIME_TICKS = "TimeTicks"
    TIME_STAMP = "TimeStamp"  # TimeTicks: sysUpTime at an event
    TEXT = "PgwText"  # UTF-8, at most 255 octets
    ENUMERATION = "Enumeration"
    BITS = "Bits"
    OBJECT_IDENTIFIER = "OBJECT IDENTIFIER"


RANGES: Mapping[Syntax, tuple[int, int]] = {
    Syntax.INTEGER32: (-(2**31), 2**31 - 1),
    Syntax.ENUMERATION: (-(2**31), 2**31 - 1),
    Syntax.UNSIGNED32: (0, 2**32 - 1),
    Syntax.GAUGE32: (0, 2**32 - 1),
}
"""Range of the syntaxes that never wrap."""


class Changes(Enum):
    """When a cell can change; decides how long its encoding may be kept."""

    NEVER = "never"  # configuration
    WITH_SNAPSHOT = "with snapshot"  # a function of the device's snapshot alone
    ALWAYS = "always"  # a clock or a counter


@dataclass(frozen=True, slots=True)
class Gateway:
    """The row of every scalar: everything that the MIB tells, apart from time."""

    site: Site
    version: str
    started_at: float  # monotonic; sysUpTime counts from here
    modbus: ModbusServerStats
    snmp: SnmpCounters
    contact: str
    location: str
    object_id: Oid  # sysObjectID
    capabilities: tuple[tuple[Oid, str], ...]  # rows of sysORTable
    conditions: Conditions | None = None  # None: nobody watches them
    authentication_traps: bool = False  # whether authenticationFailure is sent
    clients: ClientRows = field(default_factory=ClientRows)

    def ticks(self, at: float) -> int:
        """Moment `at` as sysUpTime, hundredths of a second; 0 for moments before the start."""
        return ticks_since(self.started_at, at)


def ticks_since(started_at: float, at: float) -> int:
    """Hundredths of a second from one moment to another; 0 where that is before it."""
    return max(0, int((at - started_at) * 100))


@dataclass(frozen=True, slots=True)
class LineRow:
    """A row of the line table."""

    gateway: Gateway
    line: LinePort


@dataclass(frozen=True, slots=True)
class DeviceRow:
    """A row of every table that is indexed by unit id."""

    gateway: Gateway
    device: Device


class ConditionRow(NamedTuple):
    """A row of the condition table; `of` are the conditions of its device, None for those of the gateway.

    A tuple, for it is made whenever a cell of it is asked for (rows.py).
    """

    gateway: Gateway
    watch: Watch
    of: DeviceConditions | None


@dataclass(frozen=True, slots=True)
class ClientRow:
    """A row of the table of Modbus TCP clients, whoever is in it."""

    gateway: Gateway
    number: int  # 1 and above


@dataclass(frozen=True, slots=True)
class CapabilityRow:
    """A row of sysORTable."""

    gateway: Gateway
    position: int  # 0-based


class EntityRow(NamedTuple):
    """A row of entPhysicalTable: the gateway itself, a device of it, or what a device measures; a tuple as above."""

    gateway: Gateway
    number: int  # its index
    position: int  # among those with the same container, from 1
    device: Device | None = None
    point: Point | None = None  # with a device only


Row = Gateway | LineRow | DeviceRow | ConditionRow | ClientRow | CapabilityRow | EntityRow


@dataclass(frozen=True, slots=True)
class Convention:
    """A textual convention: the labels of an enumeration or a bit field."""

    name: str  # PgwChargeState
    syntax: Syntax  # ENUMERATION or BITS
    labels: tuple[tuple[int, str], ...]  # by number, lower-case-first without hyphen or underscore
    description: str


@dataclass(frozen=True, slots=True)
class ObjectType:
    """A scalar or a column.

    `get(row, now)` gives the value; `row` is of the kind that the group or table says. `models` names the
    models that have the column, `only` tells it of a row; None: every row has it.
    """

    number: int
    name: str
    syntax: Syntax
    description: str
    get: Callable[[Any, float], CellValue]
    units: str = ""
    convention: Convention | None = None
    changes: Changes = Changes.ALWAYS
    models: frozenset[str] | None = None
    point: str | None = None  # the map's point; without a shown value of it there is no cell
    only: Callable[[Any], bool] | None = None
    encodings: Mapping[Value, bytes] | None = field(default=None, compare=False, repr=False)  # of a point: by its value
    alike: bool = False  # never changes, and is the same in all rows of one kind (rows.py)
    of_values: bool = False  # like `point`, of the row's: a device that shows no values has no cell here


@dataclass(frozen=True, slots=True)
class ScalarGroup:
    """Scalars `base.<number>.0`."""

    base: Oid
    number: int  # last arc of base
    name: str
    description: str
    objects: tuple[ObjectType, ...]


class RowKind(Enum):
    """What the rows of a table are."""

    LINE = "line"
    DEVICE = "device"
    CONDITION = "condition"
    CLIENT = "client"
    LOG = "log"
    CAPABILITY = "capability"
    ENTITY = "entity"
    SENSOR = "sensor"  # those entities that measure


@dataclass(frozen=True, slots=True)
class Index:
    """An index object of a table: an Unsigned32 that is not accessible."""

    number: int  # its column
    name: str
    least: int
    most: int
    description: str


@dataclass(frozen=True, slots=True)
class Table:
    """Cells `base.1.<column>.<index>`; the index is one integer and column 1, unless `indexes` says more."""

    base: Oid
    number: int  # last arc of base
    name: str  # without "Table": pgwLine
    description: str
    rows: RowKind
    index: str  # name of the index object
    columns: tuple[ObjectType, ...]
    index_of: str | None = None  # the table that owns the index, when this one borrows it
    indexes: tuple[Index, ...] = ()  # its own index objects, behind the one that it borrows


def text(value: str) -> bytes:
    """`value` as PgwText: UTF-8, cut to 255 octets at a character."""
    octets = value.encode()
    return octets if len(octets) <= 255 else octets[:255].decode(errors="ignore").encode()


def in_range(syntax: Syntax, value: int) -> bool:
    """Whether `value` fits the syntax."""
    low, high = RANGES[syntax]
    return low <= value <= high
