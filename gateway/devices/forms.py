"""From TOML to the frozen model: the form of a map file, strictly.

A running gateway takes the maps that this made (schema.py), and does not load this file.

Rule 1: an unknown key, a missing key or a value of another type is an error; nothing is guessed or coerced.
Rule 2: all problems are reported at once, each line with the file and the entry it is about.
Rule 3: form is checked here, sense in `checks.py`; a `DeviceMap` that leaves this module passed both.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from types import MappingProxyType
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from gateway.devices.checks import problems_of
from gateway.devices.model import (
    Access,
    Bit,
    BitConditions,
    DeviceMap,
    Emc1Form,
    Emc1Object,
    EnumValue,
    Extent,
    Group,
    Growing,
    IdentityRules,
    LoadRule,
    LogField,
    LogLayout,
    MibColumn,
    NightRule,
    Point,
    PollClass,
    Reading,
    Released,
    Space,
    WordOrder,
)
from gateway.devices.texts import MAX_WORDS, TEXT_CODECS
from gateway.errors import MapError

DOCUMENT_READING = "document"
"""Name of a point's first reading."""

Address = Annotated[int, Field(ge=0, le=0xFFFF, strict=True)]
Number = int | float
Label = Annotated[str, Field(pattern=r"^[a-z][a-z0-9]*(_[a-z0-9]+)*$")]
Text = Annotated[str, Field(min_length=1, pattern=r"^\S.*\S$|^\S$")]
SpaceName = Literal["registers", "coils"]
OrderName = Literal["hi-lo", "lo-hi"]


class _Form(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


class _Extent(_Form):
    name: Label
    space: SpaceName = "registers"
    first: Address
    last: Address
    poll: Literal["live", "settings", "background"] = "background"
    writable: bool = False
    wears: bool = False
    products: tuple[Text, ...] = Field(default=(), strict=False)
    doc: Text

    def build(self) -> Extent:
        return Extent(
            self.name,
            Space(self.space),
            self.first,
            self.last,
            PollClass(self.poll),
            self.writable,
            self.doc,
            self.wears,
            self.products,
        )


class _Reading(_Form):
    """How the words of a point are read: value = raw × scale / 2^shift × what `scaled_by` names."""

    codec: str
    order: OrderName | None = None
    scale: Number = 1
    shift: Annotated[int, Field(ge=0, le=32)] = 0
    scaled_by: tuple[Label, ...] = Field(default=(), strict=False)
    absent: tuple[Annotated[int, Field(ge=0)], ...] = Field(default=(), strict=False)

    def reading(self, name: str, evidence: str) -> Reading:
        scale = float(self.scale) / 2**self.shift
        order = WordOrder(self.order or "hi-lo")
        return Reading(name, self.codec, order, scale, evidence, self.scaled_by, frozenset(self.absent))


class _Alternative(_Reading):
    name: Label
    evidence: Text

    def build(self) -> Reading:
        return self.reading(self.name, self.evidence)


class _Mib(_Form):
    column: Annotated[int, Field(ge=2)]  # 1 is the index
    scale: Annotated[int, Field(ge=1)] = 1
    units: str = ""
    syntax: Literal["Integer32", "Unsigned32", "Enumeration", "Bits", "Text"]
    named: Label | None = None

    def build(self) -> MibColumn:
        return MibColumn(self.column, self.scale, self.units, self.syntax, self.named)


class _Conditions(_Form):
    first: Annotated[int, Field(ge=100, le=900)]
    name: Label

    def build(self) -> BitConditions:
        return BitConditions(self.first, self.name)


class _Emc1(_Form):
    number: Annotated[int, Field(ge=1)]
    form: Literal["float", "integer", "unsigned", "counts", "word", "bits"]
    step: Annotated[Number, Field(gt=0)] | None = None

    def build(self) -> Emc1Object:
        return Emc1Object(self.number, Emc1Form(self.form), _float(self.step))


class _Point(_Reading):
    name: Label
    space: SpaceName = "registers"
    address: Address
    words: Annotated[int, Field(ge=1, le=MAX_WORDS)] = 1
    symbol: Text
    group: Literal["live", "energy", "today", "settings", "command"]
    unit: str = ""
    help: Text
    doc: Text
    access: Literal["read", "write", "set"] = "read"
    evidence: Text = "the document"
    alternative: tuple[_Alternative, ...] = Field(default=(), strict=False)
    minimum: Number | None = None
    maximum: Number | None = None
    plausible: Annotated[tuple[Number, Number] | None, Field(strict=False)] = None
    multiplied_by: Label | None = None
    enumeration: Label | None = None
    bits: Label | None = None
    confidence: Literal["documented", "low"] = "documented"
    note: str = ""
    rewrite_s: Annotated[Number, Field(gt=0)] | None = None
    released: Literal["zero", "negative"] = "zero"
    restarts: bool = False
    named_only: bool = False
    wears: bool = False
    conditions: _Conditions | None = None
    setpoint: bool = False
    mib: _Mib | None = None
    emc1: _Emc1 | None = None
    metric: Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$")] | None = None
    metric_scale: Number = 1

    def order_problems(self) -> list[str]:
        """A pair or a text without an order, or a single word with one."""
        found = []
        for name, entry in ((DOCUMENT_READING, self), *((entry.name, entry) for entry in self.alternative)):
            ordered = self.words > 1 or entry.codec in TEXT_CODECS
            if ordered and entry.order is None:
                found.append(f"reading {name}: a {16 * self.words}-bit point needs order hi-lo or lo-hi")
            if not ordered and entry.order is not None:
                found.append(f"reading {name}: a single word has no order")
        return found

    def build(self) -> Point:
        first = self.reading(DOCUMENT_READING, self.evidence)
        return Point(
            name=self.name,
            space=Space(self.space),
            address=self.address,
            words=self.words,
            symbol=self.symbol,
            group=Group(self.group),
            unit=self.unit,
            help=self.help,
            doc=self.doc,
            access=Access(self.access),
            readings=(first, *(alternative.build() for alternative in self.alternative)),
            minimum=_float(self.minimum),
            maximum=_float(self.maximum),
            enumeration=self.enumeration,
            bits=self.bits,
            confidence=self.confidence,
            mib=None if self.mib is None else self.mib.build(),
            metric=self.metric,
            metric_scale=float(self.metric_scale),
            plausible=None if self.plausible is None else (float(self.plausible[0]), float(self.plausible[1])),
            multiplied_by=self.multiplied_by,
            note=self.note,
            rewrite_s=None if self.rewrite_s is None else float(self.rewrite_s),
            released=Released(self.released),
            restarts=self.restarts,
            named_only=self.named_only,
            wears=self.wears,
            conditions=None if self.conditions is None else self.conditions.build(),
            setpoint=self.setpoint,
            emc1=None if self.emc1 is None else self.emc1.build(),
        )


class _EnumValue(_Form):
    number: Address
    name: Label
    text: Text


class _Bit(_Form):
    number: Annotated[int, Field(ge=0, le=31)]
    name: Label
    text: Text
    severity: Literal["info", "warning", "critical"]


class _LogField(_Form):
    name: Label
    symbol: Text
    offset: Annotated[int, Field(ge=0)]
    words: Annotated[int, Field(ge=1, le=2)] = 1
    codec: str
    scale: Number = 1
    unit: str = ""
    bits: Label | None = None
    help: Text
    column: Annotated[int, Field(ge=4)] | None = None  # 1 is the hourmeter, 2 and 3 are the date and its error


class _Log(_Form):
    first: Address
    blocks: Annotated[int, Field(ge=1)]
    block_words: Annotated[int, Field(ge=1)]
    doc: Text
    field: tuple[_LogField, ...] = Field(strict=False)

    def build(self) -> LogLayout:
        fields = tuple(
            LogField(**entry.model_dump(exclude={"scale"}), scale=float(entry.scale)) for entry in self.field
        )
        return LogLayout(self.first, self.blocks, self.block_words, fields, self.doc)


class _Growing(_Form):
    point: Label
    per_hour: Annotated[Number, Field(gt=0)]
    clearable: bool = False
    stored: Label | None = None

    def build(self) -> Growing:
        return Growing(self.point, float(self.per_hour), self.clearable, self.stored)


class _Night(_Form):
    point: Label
    value: int


class _Load(_Form):
    point: Label
    disconnected: tuple[int, ...] = Field(strict=False)
    connected: tuple[int, ...] = Field(strict=False)

    def build(self) -> LoadRule:
        return LoadRule(self.point, frozenset(self.disconnected), frozenset(self.connected))


class _Emc1Root(_Form):
    root: Annotated[str, Field(pattern=r"^1\.3\.6\.1\.4\.1(\.[1-9][0-9]{0,8})+$")]

    def build(self) -> tuple[int, ...]:
        return tuple(map(int, self.root.split(".")))


class _Identity(_Form):
    vendor: Text
    product_prefixes: tuple[Text, ...] = Field(strict=False)
    product_codes: tuple[Text, ...] = Field(strict=False)
    serial_first: Address | None = None
    serial_words: Annotated[int, Field(ge=0)] = 0
    serial_order: OrderName = "hi-lo"
    growing: tuple[_Growing, ...] = Field(default=(), strict=False)

    def build(self) -> IdentityRules:
        return IdentityRules(
            self.product_prefixes,
            self.product_codes,
            self.vendor,
            self.serial_first,
            self.serial_words,
            WordOrder(self.serial_order),
            tuple(growing.build() for growing in self.growing),
        )


FunctionCode = Annotated[str, Field(pattern=r"^[1-9][0-9]{0,2}$")]


class _File(_Form):
    model: Annotated[str, Field(pattern=r"^[a-z0-9]+(-[a-z0-9]+)*$")]
    title: Text
    document: Text
    functions: dict[FunctionCode, SpaceName]
    write_functions: dict[FunctionCode, SpaceName] = {}
    identity: _Identity
    night: _Night | None = None
    load: _Load | None = None
    emc1: _Emc1Root | None = None
    extent: tuple[_Extent, ...] = Field(strict=False)
    reserved: tuple[_Extent, ...] = Field(default=(), strict=False)
    enumeration: dict[Label, Annotated[tuple[_EnumValue, ...], Field(strict=False)]] = {}
    bits: dict[Label, Annotated[tuple[_Bit, ...], Field(strict=False)]] = {}
    point: tuple[_Point, ...] = Field(strict=False)
    log: _Log | None = None

    def build(self) -> DeviceMap:
        return DeviceMap(
            model=self.model,
            title=self.title,
            document=self.document,
            functions=MappingProxyType({int(code): Space(space) for code, space in self.functions.items()}),
            write_functions=MappingProxyType({int(code): Space(space) for code, space in self.write_functions.items()}),
            extents=tuple(entry.build() for entry in self.extent),
            reserved=tuple(entry.build() for entry in self.reserved),
            points=tuple(entry.build() for entry in self.point),
            enumerations=MappingProxyType(
                {
                    name: tuple(EnumValue(value.number, value.name, value.text) for value in values)
                    for name, values in self.enumeration.items()
                }
            ),
            bit_tables=MappingProxyType(
                {
                    name: tuple(Bit(bit.number, bit.name, bit.text, bit.severity) for bit in bits)
                    for name, bits in self.bits.items()
                }
            ),
            log=None if self.log is None else self.log.build(),
            identity=self.identity.build(),
            night=NightRule(self.night.point, self.night.value) if self.night is not None else None,
            load=None if self.load is None else self.load.build(),
            emc1_root=None if self.emc1 is None else self.emc1.build(),
        )


def _float(value: float | None) -> float | None:
    return None if value is None else float(value)


def _entry(loc: tuple[int | str, ...], raw: Mapping[str, Any]) -> str:
    """What a pydantic location is about, in the file's own words: `point battery_voltage: codec`."""
    here: Any = raw
    words: list[str] = []
    for step in loc:
        try:
            here = here[step]
        except (KeyError, IndexError, TypeError):
            here = None
        if isinstance(step, int):
            name = here.get("name") if isinstance(here, dict) else None
            words[-1:] = [f"{words[-1] if words else ''} {name if name is not None else f'#{step + 1}'}".strip()]
        elif step != "[key]":
            words.append(step)
    return ": ".join(words) or "file"


def parse_map(text: str, source: str) -> DeviceMap:
    """Read a map from TOML text; MapError names `source` and every entry that is wrong."""
    try:
        raw = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise MapError(f"{source}: not TOML: {error}") from error
    try:
        form = _File.model_validate(raw)
    except ValidationError as error:
        found = [f"{_entry(problem['loc'], raw)}: {problem['msg']}" for problem in error.errors()]
        raise MapError(_message(source, found)) from error
    device_map = form.build()
    found = [f"point {entry.name}: {problem}" for entry in form.point for problem in entry.order_problems()]
    found += problems_of(device_map)
    if found:
        raise MapError(_message(source, found))
    return device_map


def _message(source: str, problems: list[str]) -> str:
    return "\n".join(f"{source}: {problem}" for problem in problems)
