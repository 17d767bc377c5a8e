"""How the demo shows a view: tables on a terminal, lines where there is none.

Two rows a controller, so that everything fits in 80 columns. The commands stand under the tables as they are
pasted: one line each, never wrapped, and printed again only when the table is.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rich import box
from rich.console import Console, Group
from rich.table import Table
from rich.text import Text

from gateway.cli.demo_commands import Try
from gateway.cli.demo_view import DeviceView, LineView, View

_QUALITY_STYLE = {"online": "green", "stale": "yellow", "offline": "red"}
_NONE = "–"


def fitting(view: View, rates: Mapping[str, float], commands: Sequence[Try], console: Console) -> Group:
    """The live picture, with as much around the commands as the terminal has room for."""
    wide, narrow = (
        (_devices(view.devices, edges=edges), _lines(view.lines, rates, edges=edges)) for edges in (True, False)
    )
    for tables, labels in ((wide, True), (wide, False), (narrow, False)):
        picture = Group(*tables, commands_text(commands, labels=labels))
        if len(console.render_lines(picture)) < console.height:
            return picture
    return Group(commands_text(commands, labels=False), *narrow)


def commands_text(commands: Sequence[Try], *, labels: bool) -> Text:
    """The commands to try, each on a line of its own; with `labels`, what it shows stands above it."""
    text = Text("Try these in another terminal, in this folder. Ctrl-C here stops everything.\n", style="bold")
    for each in commands:
        if labels:
            text.append(f"# {each.shows}\n", style="not bold dim")
        text.append(f"{each.command}\n", style="not bold cyan")
    text.rstrip()
    text.no_wrap = True
    text.overflow = "ignore"
    return text


def plain_lines(view: View, rates: Mapping[str, float]) -> list[str]:
    """One line a controller and a line, for a log or a pipe."""
    rows = [
        f"{device.line}/{device.name} unit={device.unit_id} battery={_pair(device, 'battery')} "
        f"array={_pair(device, 'array')} load={_pair(device, 'load')} "
        f"charge={device.states.get('charge_state', _NONE)} "
        f"load_state={device.states.get('load_state', _NONE)} "
        f"age={_age(device).replace(' ', '')} quality={device.quality}"
        for device in view.devices
    ]
    rows += [
        f"{line.name} {'up' if line.up else 'DOWN'} use={line.use_ratio:.0%} requests/s={_rate(rates, line)} "
        f"errors={line.errors:.0f}"
        for line in view.lines
    ]
    return rows


_PAIRS = {
    "battery": (("battery_voltage", "V", 2), ("battery_current_net", "A", 1)),
    "array": (("array_voltage", "V", 1), ("charge_power", "W", 0)),
    "load": (("load_voltage", "V", 2), ("load_current", "A", 1)),
}

_INSTEAD = {"battery_current_net": "charge_current"}
"""What a model without a load output says of the battery."""


def _devices(devices: Sequence[DeviceView], *, edges: bool) -> Table:
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False, show_edge=edges)
    table.add_column("unit", justify="right", no_wrap=True)
    table.add_column("device\nline", overflow="ellipsis", no_wrap=True, min_width=9)
    for heading in ("battery", "array", "load"):
        table.add_column(heading, justify="right", no_wrap=True, min_width=7)
    table.add_column("charge state\nload state", no_wrap=True, min_width=12)
    table.add_column("age", justify="right", no_wrap=True, min_width=6)
    table.add_column("quality", no_wrap=True, min_width=7)
    for device in devices:
        table.add_row(
            str(device.unit_id),
            Text(f"{device.name}\n{device.line}"),
            *(_stacked(device, name) for name in _PAIRS),
            Text("\n".join(device.states.get(name, _NONE) for name in ("charge_state", "load_state"))),
            _age(device),
            Text(device.quality, style=_QUALITY_STYLE.get(device.quality, "dim")),
        )
    return table


def _lines(lines: Sequence[LineView], rates: Mapping[str, float], *, edges: bool) -> Table:
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False, show_edge=edges)
    table.add_column("line", overflow="ellipsis")
    for heading in ("port", "use", "requests/s", "errors"):
        table.add_column(heading, justify="right", no_wrap=True)
    for line in lines:
        port = Text("up", style="green") if line.up else Text("down", style="red")
        table.add_row(Text(line.name), port, f"{line.use_ratio:.0%}", _rate(rates, line), f"{line.errors:.0f}")
    return table


def _stacked(device: DeviceView, name: str) -> str:
    return "\n".join(_number(device, *number) for number in _PAIRS[name])


def _pair(device: DeviceView, name: str) -> str:
    return "/".join(_number(device, *number).replace(" ", "") for number in _PAIRS[name])


def _number(device: DeviceView, point: str, unit: str, digits: int) -> str:
    value = device.numbers.get(point)
    if value is None and point in _INSTEAD:
        value = device.numbers.get(_INSTEAD[point])
    return _NONE if value is None else f"{value:.{digits}f} {unit}"


def _age(device: DeviceView) -> str:
    return _NONE if device.age_s is None else f"{device.age_s:.1f} s"


def _rate(rates: Mapping[str, float], line: LineView) -> str:
    return f"{rates[line.name]:.1f}" if line.name in rates else _NONE
