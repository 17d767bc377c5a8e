"""`prostar-gateway log`: the stored days, as a table or for other programs."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from enum import StrEnum
from io import TextIOWrapper
from itertools import groupby
from operator import attrgetter
from pathlib import Path
from typing import Annotated

import typer
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn
from rich.table import Table

from gateway.cli.config_file import ConfigOption, load_or_exit
from gateway.core.daylog import LogFormat, Selection, parse_moment
from gateway.errors import HistoryError
from gateway.history.columns import Column, columns
from gateway.history.export import export, rows_to_read, timestamp
from gateway.history.reader import HistoryReader, StoredDay
from gateway.service.settings import line_sites

BAR_AFTER_S = 1.0
WIDE = 104
"""Columns from which on a table has the long names."""

_HOUR_S = 3600.0


class Form(StrEnum):
    """What the command can print."""

    TABLE = "table"
    CSV = LogFormat.CSV.value
    JSON = LogFormat.JSON.value
    JSONL = LogFormat.JSONL.value
    OPENMETRICS = LogFormat.OPENMETRICS.value


def command(
    config: ConfigOption,
    device: Annotated[
        str | None, typer.Option(metavar="NAME", help="Only this device, by the name it has or had.")
    ] = None,
    since: Annotated[
        str | None, typer.Option(metavar="DATE", help="Only days written at or after this date or moment, UTC.")
    ] = None,
    until: Annotated[
        str | None, typer.Option(metavar="DATE", help="Only days written before this moment, or until this date's end.")
    ] = None,
    form: Annotated[Form, typer.Option("--format", help="How to print them.")] = Form.TABLE,
) -> None:
    """Print the days that are stored of the controllers' logs; the gateway may run meanwhile."""
    selection = Selection(device, _moment(since, "--since"), _moment(until, "--until", end=True))
    checked = load_or_exit(config)
    try:
        with HistoryReader(Path(checked.state_dir), line_sites(checked)) as reader:
            known = reader.devices() | {table.name for line in checked.line for table in line.device}
            if device is not None and device not in known:
                names = ", ".join(sorted(known))
                raise typer.BadParameter(f"no device is called {device!r}; there are: {names}", param_hint="--device")
            if form is Form.TABLE:
                _table(reader, selection)
            else:
                _export(reader, LogFormat(form.value), selection, checked.site)
    except HistoryError as error:
        print(error, file=sys.stderr)
        raise typer.Exit(1) from None


def _moment(text: str | None, option: str, *, end: bool = False) -> float | None:
    try:
        return None if text is None else parse_moment(text, end=end)
    except ValueError as error:
        raise typer.BadParameter(str(error), param_hint=option) from None


def _export(reader: HistoryReader, form: LogFormat, selection: Selection, site: str) -> None:
    if isinstance(sys.stdout, TextIOWrapper):
        sys.stdout.reconfigure(encoding="utf-8")  # as JSON and OpenMetrics are, whatever this terminal has
    with _bar(rows_to_read(reader, form, selection)) as progress:
        for piece in export(reader, form, selection, site, progress):
            sys.stdout.write(piece)
    sys.stdout.flush()
    if form is LogFormat.OPENMETRICS:
        undated = sum(day.written_at is None for day in reader.days(selection))
        if undated:
            print(f"{undated} days have no date yet and were left out", file=sys.stderr)


@contextmanager
def _bar(total: int) -> Iterator[Callable[[int], None]]:
    """A progress bar on standard error, if that is a terminal, from the first second on."""
    console = Console(stderr=True)
    if not console.is_terminal:
        yield lambda _rows: None
        return
    parts = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    with Progress(*parts, console=console, transient=True) as bar:
        task = bar.add_task("reading days", total=total, visible=False)

        def progress(rows: int) -> None:
            bar.advance(task, rows)
            if not bar.tasks[0].visible and (bar.tasks[0].elapsed or 0.0) > BAR_AFTER_S:
                bar.update(task, visible=True)

        yield progress


def _table(reader: HistoryReader, selection: Selection) -> None:
    """A table a controller; on a narrow terminal with the document's short names, explained below it."""
    console = Console()
    wide = console.width >= WIDE
    days, controllers = 0, 0
    for owner, group in groupby(reader.days(selection), key=attrgetter("owner")):
        of_model = columns(owner.model)
        numbers = [column for column in of_model if column.bits is None]
        known_as = "" if owner.identity == f"{owner.line}/{owner.device}" else f", controller {owner.identity}"
        title = escape(f"{owner.device} on {owner.line}{known_as}")
        table = Table(box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0), title=title, title_justify="left")
        table.add_column("written (UTC)\nabout", no_wrap=True)
        table.add_column("±\nh", justify="right", no_wrap=True)
        if wide:
            table.add_column("hour-\nmeter\nh", justify="right", no_wrap=True)
        for column in numbers:
            table.add_column(_heading(column, wide=wide), justify="right", no_wrap=True)
        occurred = []
        for day in group:
            days += 1
            date = (timestamp(day.written_at) or "no date yet")[:16].replace("T", " ")
            error = "" if day.error_s is None else f"{day.error_s / _HOUR_S:.1f}"
            hours = [str(day.hourmeter)] if wide else []
            table.add_row(date, error, *hours, *(_cell(column, day) for column in numbers))
            if events := _events(day, of_model):
                occurred.append(f"  {date}  {events}")
        console.print(table)
        if not wide:
            short = (f"{_short(column)}: {column.field.name.replace('_', ' ')}" for column in numbers)
            console.print("; ".join(short), highlight=False, markup=False)
        for line in occurred:
            console.print(line, highlight=False, markup=False, soft_wrap=True)
        controllers += 1
    apart = list(reader.apart(selection))
    print(f"{_count(days, 'day')} of {_count(controllers, 'controller')}; {_count(len(apart), 'block')} kept apart")
    for block in apart:
        print(f"  {block.owner.device}: block {block.slot}, hourmeter {block.hourmeter} h, {block.why}")


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'s' * (number != 1)}"


def _short(column: Column) -> str:
    return column.field.symbol.removesuffix("_daily")


def _heading(column: Column, *, wide: bool) -> str:
    words = column.field.name.split("_") if wide else _short(column).split("_")
    return "\n".join([*words, "h:mm" if column.field.unit == "s" else column.field.unit])


def _cell(column: Column, day: StoredDay) -> str:
    value = day.values.get(column.field.name)
    if value is None:
        return ""
    if column.field.unit == "s":
        minutes = round(value / 60)
        return f"{minutes // 60}:{minutes % 60:02}"
    return f"{value:.2f}" if column.field.unit == "V" else f"{value:.1f}"


def _events(day: StoredDay, of_model: tuple[Column, ...]) -> str:
    named = ((column.field.name, column.show(day.values)) for column in of_model if column.bits is not None)
    return "; ".join(
        f"{name.replace('_', ' ')}: {', '.join(bits)}" for name, bits in named if isinstance(bits, list) and bits
    )
