"""What a device map says, as frozen data.

A map (`maps/<model>.toml`) is read by `devices/schema.py` into these classes; everything that knows a
register (decoding, poll plan, MIB, metrics, documentation, simulator) reads them from here.

Addresses are PDU addresses (0-based), never logical ones.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum

TEXT_CODEC_NAMES = frozenset({"ascii", "ipv4", "mac", "version"})
"""The codecs whose values are texts (devices/texts.py)."""

Value = float | int
"""A decoded value: float for measured points, int for counters, enumerations and bit fields. No value is `None`."""


class Space(StrEnum):
    """An address space of the device; the map names the functions that read it."""

    REGISTERS = "registers"
    COILS = "coils"


class WordOrder(StrEnum):
    """Which word of a 32-bit pair has the lower address; of a text, which byte of each word comes first."""

    HI_LO = "hi-lo"
    LO_HI = "lo-hi"


class Access(StrEnum):
    """What the device lets a client do with a point."""

    READ = "read"
    WRITE = "write"  # and read
    SET = "set"  # set only, always reads 0


class Group(StrEnum):
    """What a point is about; decides its poll class and its MIB table."""

    LIVE = "live"
    ENERGY = "energy"
    TODAY = "today"
    SETTINGS = "settings"
    COMMAND = "command"  # coils and registers that only make sense to write; never polled


class PollClass(StrEnum):
    """How often a block is read."""

    LIVE = "live"
    SETTINGS = "settings"
    BACKGROUND = "background"  # the daily log: read by history/, never by the poll plan


@dataclass(frozen=True, slots=True)
class Extent:
    """A run of addresses that the device answers; outside of all extents it answers exception 02."""

    name: str
    space: Space
    first: int
    last: int
    poll: PollClass
    writable: bool
    doc: str
    wears: bool = False  # memory that lasts only so many writes (EEPROM)
    products: tuple[str, ...] = ()  # the product codes that have it; empty: all of the model

    @property
    def count(self) -> int:
        """Number of registers or coils."""
        return self.last - self.first + 1


@dataclass(frozen=True, slots=True)
class Reading:
    """One way to read the words of a point (the document's, or one seen in the field)."""

    name: str
    codec: str  # a name in devices/codecs.py or devices/texts.py
    order: WordOrder
    scale: float  # value = raw × scale × the values of the points in `factors`
    evidence: str
    factors: tuple[str, ...] = ()  # points of the same device that tell its scaling
    absent: frozenset[int] = frozenset()  # raw numbers that stand for "no value"


@dataclass(frozen=True, slots=True)
class MibColumn:
    """The point's cell in the MIB; numbers are append-only (mibs/oids.lock)."""

    column: int
    scale: int  # SNMP integer = round(value × scale)
    units: str  # UNITS clause; "" for enumerations and bit fields
    syntax: str  # "Integer32", "Unsigned32", "Enumeration", "Bits" or "Text"
    named: str | None = None  # what the object is called after, where models cannot share one: None: the point


class Released(StrEnum):
    """What must be written to end control over a device that has to be rewritten (`Point.rewrite_s`)."""

    BY_ZERO = "zero"
    BY_NEGATIVE = "negative"  # and a zero changes nothing

    def held_by(self, word: int, *, held: bool) -> bool:
        """Whether the device is controlled after `word` was written; `held` says whether it was before."""
        if self is Released.BY_ZERO:
            return word != 0
        return 0 < word < 0x8000 or (word == 0 and held)


class Kind(StrEnum):
    """What the values of a point are."""

    NUMBER = "number"
    ENUMERATION = "enumeration"
    BITS = "bits"
    TEXT = "text"


class Emc1Form(StrEnum):
    """How Morningstar's Ethernet converter writes a value."""

    FLOAT = "float"  # a text: "53.9375", "nan"
    INTEGER = "integer"  # the number of an enumeration or of switches
    UNSIGNED = "unsigned"  # in steps, or in the point's MIB scale: 0.1 Ah
    COUNTS = "counts"  # signed, in steps
    WORD = "word"  # the register as it was read, unsigned
    BITS = "bits"  # four octets, bit 0 first


@dataclass(frozen=True, slots=True)
class Emc1Object:
    """The point in the flat MIB of that converter; numbers and steps are the vendor's."""

    number: int
    form: Emc1Form
    step: float | None = None  # what one stands for, in the point's unit


@dataclass(frozen=True, slots=True)
class BitConditions:
    """Each bit of a point is a condition: its number there is `first` + the bit's, its name begins with `name`."""

    first: int
    name: str  # snake_case: array_fault


@dataclass(frozen=True, slots=True)
class Point:
    """A named value of a device.

    `readings[0]` is the document's reading and the default; a device may choose another by name.
    """

    name: str  # snake_case, shared between models: battery_voltage
    space: Space
    address: int
    words: int
    symbol: str  # the document's variable name: adc_vb_f_1m
    group: Group
    unit: str  # "V", "A", "W", "°C", "Ah", "kWh", "h", "s", "d", "Ω", "V/°C", "" …
    help: str
    doc: str  # where in the document
    access: Access
    readings: tuple[Reading, ...]
    minimum: float | None
    maximum: float | None
    enumeration: str | None  # key of DeviceMap.enumerations
    bits: str | None  # key of DeviceMap.bit_tables
    confidence: str  # "documented" or "low"
    mib: MibColumn | None
    metric: str | None  # full metric name, None where none is made
    metric_scale: float  # metric sample = value × metric_scale (kWh → Wh, min → s)
    plausible: tuple[float, float] | None = None  # a value outside is withheld and counted, never shown
    multiplied_by: str | None = None  # point that multiplies this one before the device uses it
    note: str = ""  # where document and field, or two places of the document, disagree
    rewrite_s: float | None = None  # what takes control must be written again at least this often, or the device faults
    released: Released = Released.BY_ZERO  # what ends that control
    restarts: bool = False  # a write restarts the device, which then does not answer: silence is success
    named_only: bool = False  # to be written only where its very name was allowed, never as one of a range
    wears: bool = False  # a write makes the device write its own EEPROM
    conditions: BitConditions | None = None  # what its bits are to core/conditions.py
    setpoint: bool = False  # what the device aims at or acts upon, not what it measures
    emc1: Emc1Object | None = None

    @property
    def kind(self) -> Kind:
        """What its values are."""
        if any(reading.codec in TEXT_CODEC_NAMES for reading in self.readings):
            return Kind.TEXT
        if self.bits is not None:
            return Kind.BITS
        return Kind.NUMBER if self.enumeration is None else Kind.ENUMERATION

    @property
    def polled(self) -> bool:
        """Whether the poll plan reads it and the decoder shows it."""
        return self.group is not Group.COMMAND

    @property
    def metric_type(self) -> str:
        """Prometheus type: "counter" for totals that only grow until somebody clears them, else "gauge"."""
        return "counter" if self.metric is not None and self.metric.endswith("_total") else "gauge"

    def reading(self, name: str | None = None) -> Reading:
        """The reading called `name`, or the document's; KeyError when there is none of that name."""
        if name is None:
            return self.readings[0]
        for reading in self.readings:
            if reading.name == name:
                return reading
        raise KeyError(name)


@dataclass(frozen=True, slots=True)
class EnumValue:
    """One value of an enumeration, by the device's own number."""

    number: int
    name: str  # snake_case label: night_check
    text: str


@dataclass(frozen=True, slots=True)
class Bit:
    """One named bit; bit 0 is the least significant."""

    number: int
    name: str  # snake_case label: battery_hvd
    text: str
    severity: str  # "info", "warning", "critical"


@dataclass(frozen=True, slots=True)
class LogField:
    """One field of a daily-log block, by word offset."""

    name: str
    symbol: str
    offset: int
    words: int
    codec: str
    scale: float  # to base units (minutes → seconds)
    unit: str
    bits: str | None
    help: str
    column: int | None = None  # its column in the MIB's log table; numbers are append-only (mibs/oids.lock)


@dataclass(frozen=True, slots=True)
class LogLayout:
    """Where the daily log lies and how a block is built."""

    first: int
    blocks: int
    block_words: int
    fields: tuple[LogField, ...]
    doc: str


@dataclass(frozen=True, slots=True)
class Growing:
    """A counter that only grows, and no faster than `per_hour`: two units rarely agree on it."""

    point: str
    per_hour: float
    clearable: bool  # a command sets it to zero
    stored: str | None = None  # the point that keeps it for a unit without power, as it was some time ago


@dataclass(frozen=True, slots=True)
class NightRule:
    """The value of a point that means that nothing happens until morning."""

    point: str
    value: int


@dataclass(frozen=True, slots=True)
class LoadRule:
    """The values of a point that mean that the device keeps the load disconnected, and those that it is connected.

    Any other value (switched off by somebody, starting) tells neither.
    """

    point: str
    disconnected: frozenset[int]
    connected: frozenset[int]


@dataclass(frozen=True, slots=True)
class IdentityRules:
    """How the model shows itself: Read Device Identification and an optional serial number."""

    product_prefixes: tuple[str, ...]
    product_codes: tuple[str, ...]
    vendor: str
    serial_first: int | None
    serial_words: int
    serial_order: WordOrder = WordOrder.HI_LO
    growing: tuple[Growing, ...] = ()

    def names(self, product: str) -> bool:
        """Whether a unit that calls itself `product` is of this model."""
        return product in self.product_codes or product.startswith(self.product_prefixes)


@dataclass(frozen=True, slots=True)
class DeviceMap:
    """One model, whole."""

    model: str  # "prostar-mppt"
    title: str
    document: str
    functions: Mapping[int, Space]  # read functions: 1 → coils, 3 → registers …
    write_functions: Mapping[int, Space]  # 5 → coils, 6 → registers
    extents: tuple[Extent, ...]
    reserved: tuple[Extent, ...]
    points: tuple[Point, ...]
    enumerations: Mapping[str, tuple[EnumValue, ...]]
    bit_tables: Mapping[str, tuple[Bit, ...]]
    log: LogLayout | None
    identity: IdentityRules
    night: NightRule | None = None
    load: LoadRule | None = None
    emc1_root: tuple[int, ...] | None = None  # OID above the `emc1` objects; None: that converter does not know it

    def covers(self, space: Space, first: int, end: int) -> bool:
        """Whether every address from `first` to one before `end` lies in an extent."""
        while first < end:
            inside = [e.last + 1 for e in self.extents if e.space is space and e.first <= first <= e.last]
            if not inside:
                return False
            first = max(inside)
        return True

    def on_product(self, extent: Extent, product: str) -> bool:
        """Whether a unit that calls itself `product` has the extent; of one that says nothing known, yes."""
        return not extent.products or product in extent.products or product not in self.identity.product_codes

    def writable_point(self, space: Space, address: int) -> Point | None:
        """The point that a single write to this address changes, or None."""
        for point in self.points:
            if point.space is space and point.address == address and point.access is not Access.READ:
                return point
        return None

    def wears(self, point: Point) -> bool:
        """Whether a write to the point uses up memory that lasts only so many writes."""
        return point.wears or any(
            extent.wears and extent.space is point.space and extent.first <= point.address <= extent.last
            for extent in self.extents
        )

    def read_function(self, space: Space) -> int:
        """The function that polls read this space with: of those that the device has, the lowest."""
        return min(function for function, read in self.functions.items() if read is space)

    def point(self, name: str) -> Point:
        """The point of that name; KeyError when the model has none."""
        for point in self.points:
            if point.name == name:
                return point
        raise KeyError(name)


@dataclass(frozen=True, slots=True)
class Identification:
    """What Read Device Identification (2B/0E, basic, stream) gave."""

    vendor: str
    product: str
    revision: str
