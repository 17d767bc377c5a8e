"""The page of the gateway's own registers, from the table that answers (core/status_registers.py)."""

from __future__ import annotations

from gateway.core.status_registers import COLUMNS, MOST_LINES, MOST_UNIT, UNIT, Column, Of
from gateway.generate.markdown import code, generated_mark, page, table

_ABOUT = f"""\
With `status_unit = true` in `[modbus]`, unit id {UNIT} is the gateway itself: functions 03 and 04 read these registers,
2B/0E says its name and version. It answers whatever the lines and controllers do, so that a master can tell a dead
controller from a dead gateway, and sees how old the values of a controller are. It is asked through the ports that go
by unit id, not through one that stands for a line. Nothing can be written.

Addresses are those in the request PDU, counted from 0. Numbers of 32 bits have their high word first; counters start
again from 0 after 4294967295, and those of requests are up to a second behind. Registers of lines and unit ids that are
not configured are 0; what lies between the columns is exception 02."""

_ROWS = {
    Of.LINE: f"line n, by its place in the configuration, 1 to {MOST_LINES}",
    Of.DEVICE: f"unit id n, 1 to {MOST_UNIT}",
}


def status_outputs() -> dict[str, str]:
    """The page by its path."""
    blocks = [
        generated_mark("gateway/core/status_registers.py"),
        "# Unit 255: the gateway's own registers",
        _ABOUT,
        "## The gateway",
        table(("Address", "Bits", "Name", "What"), [_row(column) for column in COLUMNS if column.of is Of.GATEWAY]),
    ]
    for of, title in ((Of.DEVICE, "Controllers"), (Of.LINE, "Lines")):
        blocks += [
            f"## {title}",
            f"*n* is {_ROWS[of]}.",
            table(("Address", "Bits", "Name", "What"), [_row(column) for column in COLUMNS if column.of is of]),
        ]
    return {"docs/registers/gateway.md": page(blocks)}


def _row(column: Column) -> tuple[str, str, str, str]:
    address = f"0x{column.first:04X}"
    if column.of is not Of.GATEWAY:
        address += " + n" if column.words == 1 else f" + {column.words} × n"
    return address, str(16 * column.words), code(column.name), column.help
