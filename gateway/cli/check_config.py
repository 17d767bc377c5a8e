"""`prostar-gateway check-config`: is the file right, and what will its lines be able to do?"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from gateway.cli.config_file import ConfigOption, load_or_exit, refuse
from gateway.clock import SystemClock
from gateway.core.budget import LineBudget
from gateway.service.advice import advice
from gateway.service.changes import NEEDS_RESTART, changes
from gateway.service.config import Config
from gateway.service.http_files import http_problems, unreadable_http
from gateway.service.settings import line_budgets, line_settings
from gateway.service.snmp import snmp_on, unreadable
from gateway.service.tls import tls_problems


def command(
    config: ConfigOption,
    quiet: Annotated[
        bool, typer.Option("--quiet", help="Print problems only; secrets that cannot be read here are some.")
    ] = False,
    against: Annotated[
        Path | None, typer.Option(metavar="FILE", help="The file in use: print what a reload would change.")
    ] = None,
) -> None:
    """Check a configuration: exit status 0 and a projection of its lines, or 78 and every problem."""
    checked = load_or_exit(config)
    problems = [*tls_problems(checked, SystemClock().wall()), *http_problems(checked)]
    if quiet:
        problems += (*unreadable(checked), *unreadable_http(checked))
    if problems:
        refuse(config, [f"{config}: {problem}" for problem in problems])
    if against is not None:
        _compare(load_or_exit(against), checked)
        return
    if quiet:
        return
    budgets = line_budgets(checked)
    console = Console()
    console.print(_lines(checked, budgets), _devices(checked, budgets), sep="\n")
    modbus = f"Modbus TCP {_at(checked.modbus.listen)}{_tls(checked)}{_of_lines(checked)}"
    for name, face in (("Faces", modbus), ("", f"SNMP {_snmp(checked)}"), ("", f"HTTP {_at(checked.http.listen)}")):
        console.print(f"{name:6} {face}", soft_wrap=True)
    if snmp_on(checked) and checked.snmp.emc1:
        console.print(f"EMC-1  {_emc1(checked)}")
    console.print(f"Writes {_writes(checked)}")
    for text in advice(checked, budgets):
        console.print(f"[yellow]warning[/] {escape(text)}", soft_wrap=True)
    console.print(f"[green]{escape(str(config))} is right.[/]", soft_wrap=True)


def _compare(before: Config, after: Config) -> None:
    """The keys that differ, by path; their values may be secret."""
    keys = changes(before, after)
    for key in keys:
        print(f"{key}: needs a restart; a reload keeps the old one" if key in NEEDS_RESTART else key)
    if not keys:
        print("A reload would read certificates and secrets again, and change nothing else.")


def _emc1(config: Config) -> str:
    """Which controllers are shown so, and where by default."""
    return " · ".join(f"unit {each.unit_id}" + f" {_at(each.listen)}" * bool(each.listen) for each in config.snmp.emc1)


def _writes(config: Config) -> str:
    """On which lines writes can go out."""
    lines = [line.name for line in line_settings(config) if line.writes]
    if not lines:
        return "refused"
    count = len(config.modbus.write)
    return f"as far as {count} rule{'s' * (count != 1)} allow{'s' * (count == 1)}, on {escape(', '.join(lines))}"


def _lines(config: Config, budgets: Sequence[LineBudget]) -> Table:
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    table.add_column("line", overflow="fold")
    table.add_column("port", overflow="fold")
    for heading in ("devices", "use", "reply deadline"):
        table.add_column(heading, justify="right", no_wrap=True)
    for line, budget in zip(config.line, budgets, strict=True):
        style = "red" if budget.use_ratio is not None and budget.use_ratio > 1 else ""
        use = "–" if budget.use_ratio is None else f"{budget.use_ratio:.0%}"
        deadline = f"{budget.reply_deadline_s:.1f} s"
        table.add_row(escape(line.name), escape(line.port), str(len(line.device)), use, deadline, style=style)
    return table


def _devices(config: Config, budgets: Sequence[LineBudget]) -> Table:
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    table.add_column("unit id", justify="right", no_wrap=True)
    for heading in ("device", "line"):
        table.add_column(heading, overflow="fold")
    table.add_column("address", justify="right", no_wrap=True)
    table.add_column("model", overflow="fold")
    for heading in ("live\nevery", "settings\nevery"):
        table.add_column(heading, justify="right", no_wrap=True)
    rows = [(device, line, budget) for line, budget in zip(config.line, budgets, strict=True) for device in line.device]
    for device, line, budget in sorted(rows, key=lambda row: row[0].unit_id):
        table.add_row(
            str(device.unit_id),
            escape(device.name),
            escape(line.name),
            str(device.address),
            device.model,
            f"{budget.live_refresh_s:.1f} s",
            f"{budget.settings_refresh_s:.0f} s",
        )
    return table


def _at(listen: Sequence[str]) -> str:
    return escape(", ".join(listen)) if listen else "off"


def _tls(config: Config) -> str:
    tls = config.modbus.tls
    return "" if tls is None or not tls.listen else f" · Modbus TLS {_at(tls.listen)}"


def _of_lines(config: Config) -> str:
    """Which listeners stand for one line."""
    shown = ((listener.line, "TLS " * listener.tls, _at(listener.listen)) for listener in config.modbus.listener)
    return "".join(f" · line {escape(line)} {tls}{listen}" for line, tls, listen in shown)


def _snmp(config: Config) -> str:
    return _at(config.snmp.listen) if snmp_on(config) else "off (no community, no user)"
