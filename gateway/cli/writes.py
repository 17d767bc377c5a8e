"""`prostar-gateway writes`: what was written to the controllers, by whom, and how it ended."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from gateway.cli.config_file import ConfigOption, part_or_exit
from gateway.core.write_ledger import Entry, entries
from gateway.devices.model import Space
from gateway.faces.modbus.ledger import read_ledger


def command(
    config: ConfigOption,
    unit: Annotated[int | None, typer.Option(min=1, max=247, help="Only writes to this unit id.")] = None,
    last: Annotated[int, typer.Option(min=1, help="So many of the latest writes.")] = 50,
    as_json: Annotated[bool, typer.Option("--json", help="One line of JSON a write instead of a table.")] = False,
) -> None:
    """Show the write ledger in the configuration's state_dir; it may be read while the gateway runs."""
    folder = Path(part_or_exit(config, "state_dir").state_dir)
    try:
        found = entries(read_ledger(folder))
    except OSError as error:
        print(f"{folder}: the ledger cannot be read: {error.strerror or error}", file=sys.stderr)
        raise typer.Exit(1) from None
    found = [entry for entry in found if unit in {None, entry.intent.unit_id}][-last:]
    if as_json:
        for entry in found:
            print(json.dumps(asdict(entry)))
        return
    if not found:
        print(f"No writes are noted in {folder}.")
        return
    Console().print(_table(found))


def _table(found: list[Entry]) -> Table:
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, collapse_padding=True)
    table.add_column("when", min_width=len("2026-11-22"))
    table.add_column("who", overflow="fold")
    table.add_column("unit", justify="right", no_wrap=True)
    table.add_column("point", overflow="fold", min_width=len("float_voltage"))
    table.add_column("address", no_wrap=True)
    for heading in ("old", "new"):
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("outcome", overflow="fold", min_width=len("not written"))
    for entry in found:
        intent = entry.intent
        when = f"{datetime.fromtimestamp(intent.at, UTC):%Y-%m-%d %H:%M:%SZ}"  # as the log has it
        who = intent.peer if intent.role is None else f"{intent.peer} ({intent.role})"
        address = f"0x{intent.address:04X}" + (" coil" if intent.space is Space.COILS else "")
        row = (when, who, str(intent.unit_id), intent.point, address, _word(intent.old), _word(intent.new))
        table.add_row(*map(escape, row), escape(_outcome(entry)))
    return table


def _word(word: int | None) -> str:
    return "?" if word is None else f"0x{word:04X}"


def _outcome(entry: Entry) -> str:
    verdict = entry.verdict
    if verdict is None:
        return "unknown: the gateway ended before it was told"
    text = str(verdict.fate).replace("_", " ")
    if verdict.exception is not None:
        text += f", exception {verdict.exception:02X}"
    if verdict.found is not None and verdict.found != entry.intent.new:
        text += f", holds {_word(verdict.found)}"
    if entry.intent.left_out:
        text += f" ({entry.intent.left_out} rewrites before it are not listed)"
    return text
