"""A page per model: every register and coil in the order of its address, with everything that is made of it."""

from __future__ import annotations

from collections.abc import Iterator

from gateway.devices.codecs import CODECS
from gateway.devices.model import Access, DeviceMap, Extent, Group, Kind, Point, PollClass, Reading, Space, WordOrder
from gateway.devices.plan import poll_plan
from gateway.devices.schema import load_map, models
from gateway.devices.texts import TEXT_CODECS
from gateway.faces.snmp.layout import column_name
from gateway.generate.markdown import bullets, code, generated_mark, page, table

_POINT_HEADINGS = (
    "Address",
    "Point",
    "In the document",
    "Unit",
    "Codec",
    "Access",
    "Poll",
    "MIB object",
    "Metric",
    "What",
)
_ORDER = {WordOrder.HI_LO: "high word first", WordOrder.LO_HI: "low word first"}
_ACCESS = {Access.READ: "read", Access.WRITE: "read, write", Access.SET: "set"}

_READING = """\
Addresses are those in the request PDU, counted from 0. A value is shown in the unit given; a half float that is
NaN or infinite is no value and is shown nowhere, as is a value outside the bounds under *Plausible values*.
*Access* is what the controller allows; the gateway writes only what a rule allows, and *by name only* what the rule
names by the point's name, not as one of a range. *Reserved* words are shown nowhere but can be read.
A dagger (†) marks low confidence, an asterisk (*) an entry under *Notes and other readings*."""


_OTHER_READINGS = """\
What to know of a point, and where the document is contradicted by itself or by units in the field. A point with more
than one reading takes the first, unless the device's configuration names another: `decode = { point = "reading" }`."""


def register_outputs() -> dict[str, str]:
    """The pages by path from the repository."""
    return {f"docs/registers/{model}.md": register_page(load_map(model)) for model in models()}


def register_page(device_map: DeviceMap) -> str:
    """The page of one model."""
    return page(_blocks(device_map))


def _blocks(device_map: DeviceMap) -> Iterator[str]:
    yield generated_mark(f"gateway/devices/maps/{device_map.model}.toml")
    yield f"# {device_map.title}: registers and coils"
    yield f"Model `{device_map.model}`, after {device_map.document}."
    yield _READING
    yield "## What it answers"
    yield _functions(device_map)
    yield table(
        ("Range", "Name", "Space", "Polled", "From"),
        (
            (_range(extent.first, extent.last), extent.name, extent.space.value, _poll(extent), extent.doc)
            for extent in device_map.extents
        ),
    )
    yield "The gateway reads these blocks, each with one request, and cuts one in two when the controller refuses it:"
    yield table(
        ("Block", "Space", "Items", "Poll class"),
        (
            (_range(block.first, block.last), block.space.value, str(block.count), block.poll.value)
            for block in poll_plan(device_map)
        ),
    )
    for extent in device_map.extents:
        if any(_lies_in(point, extent) for point in device_map.points):
            yield f"## {_title(extent)}"
            yield _points(device_map, extent)
    yield from _log(device_map)
    yield from _notes(device_map)
    yield from _limits(device_map)
    yield from _tables(device_map)


def _title(extent: Extent) -> str:
    return extent.name.upper() if extent.name in {"ram", "eeprom"} else extent.name.replace("_", " ").capitalize()


def _functions(device_map: DeviceMap) -> str:
    items = []
    for what, functions in (("read by", device_map.functions), ("written by", device_map.write_functions)):
        for space in Space:
            codes = [f"{number:02}" for number, of in sorted(functions.items()) if of is space]
            if codes:
                items.append(f"{space.value} are {what} function {' and '.join(codes)}")
    identity = device_map.identity
    items.append(
        f"Read Device Identification (2B/0E, basic, stream): vendor “{identity.vendor}”, product "
        + ", ".join(code(product) for product in identity.product_codes)
    )
    if identity.serial_first is not None:
        last = identity.serial_first + identity.serial_words - 1
        documented = any(point.address == identity.serial_first for point in device_map.points)
        items.append(
            f"serial number: text at {_range(identity.serial_first, last)}"
            f"{'' if documented else ', undocumented'}, asked for once"
        )
    return bullets(items)


def _range(first: int, last: int) -> str:
    return code(f"0x{first:04X}" if first == last else f"0x{first:04X}–0x{last:04X}")


def _poll(extent: Extent) -> str:
    return "never; read on demand" if extent.poll is PollClass.BACKGROUND else extent.poll.value


def _points(device_map: DeviceMap, extent: Extent) -> str:
    rows: list[tuple[int, tuple[str, ...]]] = [
        (point.address, _point_row(point, extent)) for point in device_map.points if _lies_in(point, extent)
    ]
    for run in device_map.reserved:
        if run.space is extent.space and extent.first <= run.first <= extent.last:
            reserved = (_range(run.first, run.last), "*reserved*", "", "", "", "", "", "", "", _sentence(run.doc))
            rows.append((run.first, reserved))
    return table(_POINT_HEADINGS, (row for _, row in sorted(rows)))


def _lies_in(point: Point, extent: Extent) -> bool:
    return point.space is extent.space and extent.first <= point.address <= extent.last


def _point_row(point: Point, extent: Extent) -> tuple[str, ...]:
    marks = ("†" if point.confidence == "low" else "") + ("*" if _noted(point) else "").replace("*", "\\*")
    text = point.help
    if point.multiplied_by is not None:
        text += f" For 12 V; in use times `{point.multiplied_by}`."
    return (
        _range(point.address, point.address + point.words - 1),
        code(point.name) + marks,
        code(point.symbol),
        point.unit,
        _codec(point, point.readings[0]),
        _ACCESS[point.access] + (", by name only" if point.named_only else ""),
        "never" if point.group is Group.COMMAND else extent.poll.value,
        code(column_name(point)) if point.mib is not None else "",
        code(point.metric or ""),
        text,
    )


def _codec(point: Point, reading: Reading) -> str:
    if point.kind is Kind.TEXT:
        swapped = ", low byte first" if reading.order is WordOrder.LO_HI else ""
        return TEXT_CODECS[reading.codec].text + swapped
    text = CODECS[reading.codec].text
    if point.words > 1:
        text += f", {_ORDER[reading.order]}"
    if reading.scale != 1:
        text += f", × {_scale(reading.scale)}"
    text += "".join(f" × `{factor}`" for factor in reading.factors)
    if reading.absent:
        text += f", no value: {', '.join(code(f'0x{raw:04X}') for raw in sorted(reading.absent))}"
    table_name = point.enumeration or point.bits
    return f"{text}, [{table_name}](#{table_name})" if table_name else text


def _scale(scale: float) -> str:
    """A scale as the document writes it: `6.6 / 2^15`, else the plain number."""
    for shift in (15, 16, 17):
        whole = round(scale * 2**shift, 9)
        if whole >= 1 and whole * 1000 == round(whole * 1000, 6) and scale < 0.001:
            return f"{whole:g} / 2^{shift}"
    return f"{scale:g}"


def _noted(point: Point) -> bool:
    return bool(point.note) or len(point.readings) > 1


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:] + ("" if text.endswith(".") else ".")


def _log(device_map: DeviceMap) -> Iterator[str]:
    layout = device_map.log
    if layout is None:
        return
    last = layout.first + layout.blocks * layout.block_words - 1
    yield "## Daily log"
    yield (
        f"{layout.blocks} blocks of {layout.block_words} words at {_range(layout.first, last)}, a ring. "
        f"{_sentence(layout.doc)} Blocks with an hourmeter of 0 or all ones were never written."
    )
    yield table(
        ("Word", "Field", "In the document", "Unit", "Codec", "What"),
        (
            (
                str(field.offset) if field.words == 1 else f"{field.offset}–{field.offset + field.words - 1}",
                code(field.name),
                code(field.symbol),
                field.unit,
                CODECS[field.codec].text
                + (f", × {field.scale:g}" if field.scale != 1 else "")
                + (f", [{field.bits}](#{field.bits})" if field.bits else ""),
                field.help,
            )
            for field in layout.fields
        ),
    )


def _notes(device_map: DeviceMap) -> Iterator[str]:
    found = [point for point in device_map.points if _noted(point)]
    if not found:
        return
    yield "## Notes and other readings"
    yield _OTHER_READINGS
    rows = []
    for point in found:
        rows.append((_range(point.address, point.address), code(point.name), "", "", point.note))
        if len(point.readings) > 1:
            rows += [
                ("", "", code(reading.name), _codec(point, reading), _sentence(reading.evidence))
                for reading in point.readings
            ]
    yield table(("Address", "Point", "Reading", "Codec", "Why"), rows)


def _limits(device_map: DeviceMap) -> Iterator[str]:
    plausible = [point for point in device_map.points if point.plausible is not None]
    written = [point for point in device_map.points if (point.minimum, point.maximum) != (None, None)]
    if plausible:
        yield "## Plausible values"
        yield "A value outside is withheld and counted; the raw register can still be read over Modbus."
        yield table(
            ("Point", "From", "To", "Unit"),
            (
                (code(point.name), f"{point.plausible[0]:.12g}", f"{point.plausible[1]:.12g}", point.unit)
                for point in plausible
                if point.plausible is not None
            ),
        )
    if written:
        yield "## What may be written"
        yield "Limits of the document; where it names none, only the codec sets them."
        yield table(
            ("Point", "From", "To", "Unit"),
            ((code(point.name), _bound(point.minimum), _bound(point.maximum), point.unit) for point in written),
        )


def _bound(value: float | None) -> str:
    return "" if value is None else f"{value:.12g}"


def _tables(device_map: DeviceMap) -> Iterator[str]:
    if device_map.enumerations:
        yield "## Enumerations"
    for name, values in device_map.enumerations.items():
        yield f"### {name}"
        yield table(("Value", "Name", "Meaning"), ((str(v.number), code(v.name), v.text) for v in values))
    if device_map.bit_tables:
        yield "## Bit fields"
        yield "Bit 0 is the least significant."
    for name, bits in device_map.bit_tables.items():
        yield f"### {name}"
        yield table(
            ("Bit", "Name", "Severity", "Meaning"),
            ((str(bit.number), code(bit.name), bit.severity, bit.text) for bit in bits),
        )
