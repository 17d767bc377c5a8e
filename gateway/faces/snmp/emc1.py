"""One device as Morningstar's own Ethernet converter (EMC-1) shows it, for templates and scripts that poll one.

That converter is an agent of one controller: flat scalars `root.N.0`, whose numbers and forms the map has. Rules:

1. sysDescr says what answers here: this gateway. sysObjectID is the vendor's root, since by that an NMS knows the kind
   of device; sysName is the device's name, since an NMS wants each of its devices to have another one.
2. The map says how a model's values are written. A text has at most four decimals, and is "nan" when the device answers
   and has no value. An integer counts the vendor's fixed steps, whatever the device's own scaling is: what multiplies
   by the step gets the value. One without a value does not exist.
3. A bit field is four octets, bit 0 the most significant bit of the first: a reader of 32 bits takes a shorter one
   for "no faults".
4. Who it is (1 to 3) always answers. Nothing else of a device that is not online exists here, as everywhere.
5. It is a tree of its own in a context of its own, so views, networks and rates hold as for every tree.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from gateway.core.site import Device
from gateway.core.snapshot import DeviceState, Snapshot
from gateway.devices.model import Emc1Form, Emc1Object, Point, Value
from gateway.faces.snmp.objects import (
    CellValue,
    Changes,
    DeviceRow,
    Gateway,
    ObjectType,
    ScalarGroup,
    Syntax,
    in_range,
    text,
)
from gateway.faces.snmp.settings import Oid
from gateway.faces.snmp.standard import APPLICATIONS, SYSTEM
from gateway.faces.snmp.tree import Tree

NO_VALUE = b"nan"
BITS_OCTETS = 4

_SYNTAXES = {
    Emc1Form.FLOAT: Syntax.TEXT,
    Emc1Form.INTEGER: Syntax.INTEGER32,
    Emc1Form.UNSIGNED: Syntax.UNSIGNED32,
    Emc1Form.COUNTS: Syntax.INTEGER32,
    Emc1Form.WORD: Syntax.INTEGER32,
    Emc1Form.BITS: Syntax.BITS,
}


def context_of(unit_id: int) -> bytes:
    """The context in which the device answers so: `name@11` for a community, contextName "11" for a user."""
    return str(unit_id).encode()


def emc1_tree(gateway: Gateway, device: Device) -> Tree:
    """Everything that is answered for one device; ValueError when the converter does not know its model."""
    root = device.map.emc1_root
    if root is None:
        raise ValueError(f"a {device.map.model} has no objects of the EMC-1")
    values = [_value(point, point.emc1) for point in device.map.points if point.emc1 is not None]
    groups = (
        ScalarGroup(SYSTEM, 1, "system", "", _system(root)),
        ScalarGroup(root, root[-1], "", "", (*_WHO, *values)),
    )
    return Tree(gateway, groups, (), single=DeviceRow(gateway, device))


def float_text(value: float) -> bytes:
    """A finite value as the converter writes it: "53.9375", "34.0"."""
    digits = f"{value:.4f}".rstrip("0")
    return (digits + "0" if digits.endswith(".") else digits).encode()


def bit_octets(value: int) -> bytes | None:
    """A bit field in four octets, None when it does not fit."""
    if not 0 <= value < 1 << 8 * BITS_OCTETS:
        return None
    return int(f"{value:0{8 * BITS_OCTETS}b}"[::-1], 2).to_bytes(BITS_OCTETS, "big")


def _fixed(number: int, syntax: Syntax, get: Callable[[DeviceRow], CellValue]) -> ObjectType:
    return ObjectType(number, "", syntax, "", lambda row, _now: get(row), changes=Changes.NEVER)


def _told(number: int, get: Callable[[Device], str]) -> ObjectType:
    return ObjectType(
        number, "", Syntax.TEXT, "", lambda row, _now: text(get(row.device)), changes=Changes.WITH_SNAPSHOT
    )


def _system(root: Oid) -> tuple[ObjectType, ...]:
    return (
        _fixed(
            1,
            Syntax.TEXT,
            lambda row: text(
                f"prostar-gateway {row.gateway.version}: {row.device.map.title} {row.device.name}, as an EMC-1 shows it"
            ),
        ),
        _fixed(2, Syntax.OBJECT_IDENTIFIER, lambda _row: root),
        ObjectType(3, "", Syntax.TIME_TICKS, "", lambda row, now: row.gateway.ticks(now)),
        _fixed(4, Syntax.TEXT, lambda row: text(row.gateway.contact)),
        _fixed(5, Syntax.TEXT, lambda row: text(row.device.name)),
        _fixed(6, Syntax.TEXT, lambda row: text(row.gateway.location)),
        _fixed(7, Syntax.INTEGER32, lambda _row: APPLICATIONS),
    )


def _product(device: Device) -> str:
    identification = device.snapshot.identification
    if identification is not None:
        return identification.product
    return device.expected.product or device.map.title


def _revision(device: Device) -> str:
    identification = device.snapshot.identification
    return "" if identification is None else identification.revision


_WHO = (
    _told(1, _product),
    _told(2, lambda device: device.snapshot.serial_number or ""),
    _told(3, _revision),
)


def _value(point: Point, described: Emc1Object) -> ObjectType:
    of_snapshot: Callable[[Snapshot], CellValue]
    if described.form is Emc1Form.FLOAT:
        of_snapshot = _float_of(point)
    elif described.form is Emc1Form.BITS:
        of_snapshot = _shown_as(point, lambda value: bit_octets(int(value)))
    elif described.form is Emc1Form.WORD:
        of_snapshot = _word_of(point)
    elif described.form in {Emc1Form.UNSIGNED, Emc1Form.COUNTS}:
        syntax, step = _SYNTAXES[described.form], _step(point, described)
        of_snapshot = _shown_as(point, lambda value: _within(syntax, value / step))
    else:
        of_snapshot = _shown_as(point, lambda value: _within(Syntax.INTEGER32, value))

    def get(row: DeviceRow, _now: float) -> CellValue:
        return of_snapshot(row.device.snapshot)

    return ObjectType(described.number, "", _SYNTAXES[described.form], "", get, changes=Changes.WITH_SNAPSHOT)


def _step(point: Point, described: Emc1Object) -> float:
    if described.step is not None:
        return described.step
    return 1.0 if point.mib is None else 1 / point.mib.scale


def _word_of(point: Point) -> Callable[[Snapshot], CellValue]:
    """The word that the point's value was made of; none where there is no value."""

    def of(snapshot: Snapshot) -> CellValue:
        block = snapshot.block_of(point) if point.name in snapshot.shown() else None
        if block is None:
            return None
        at = 2 * (point.address - block.first)
        return int.from_bytes(block.data[at : at + 2], "big")

    return of


def _float_of(point: Point) -> Callable[[Snapshot], CellValue]:
    def of(snapshot: Snapshot) -> CellValue:
        value = snapshot.shown().get(point.name)
        if value is not None:
            return float_text(value)
        was_read = snapshot.state is DeviceState.ONLINE and snapshot.block_of(point) is not None
        return NO_VALUE if was_read else None

    return of


def _shown_as(point: Point, form: Callable[[Value], CellValue]) -> Callable[[Snapshot], CellValue]:
    def of(snapshot: Snapshot) -> CellValue:
        value = snapshot.shown().get(point.name)
        return None if value is None else form(value)

    return of


def _within(syntax: Syntax, value: float) -> int | None:
    number = round(value) if math.isfinite(value) else None
    return number if number is not None and in_range(syntax, number) else None
