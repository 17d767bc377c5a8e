"""`prostar-gateway simulate`: simulated controllers on ptys, or behind Modbus TCP, until a signal stops it."""

from __future__ import annotations

import asyncio
import json
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated
from urllib.parse import urlsplit

import typer
from rich import box
from rich.console import Console
from rich.table import Table

from gateway.cli.stopping import stop_event
from gateway.devices.schema import load_map
from gateway.errors import MapError
from gateway.simulator.layout import DEMO_LAYOUT, Behaviour, LinePlan, SimulatedSite
from gateway.simulator.server import Controller
from gateway.simulator.tcp import TcpServer
from gateway.simulator.upstream import Habits, SimulatedServer

MODEL = "prostar-mppt"
HIGHEST_PORT = 65535


def command(
    *,
    line: Annotated[
        list[str] | None,
        typer.Option(
            "--line",
            metavar="NAME=ADDR,ADDR:MODEL",
            help="A line and the addresses of its controllers, with their model if it is another than --model; repeat "
            "for more lines. Default: shelter-a=1,2 and shelter-b=1,2:tristar-mppt.",
        ),
    ] = None,
    lines: Annotated[
        int | None, typer.Option(min=1, max=64, help="Instead of --line: so many lines, line-1, line-2 …")
    ] = None,
    devices: Annotated[int, typer.Option(min=1, max=247, help="Controllers on each of --lines, addresses 1 …")] = 1,
    speed: Annotated[float, typer.Option(min=0.001, max=3600, help="Seconds of their day per second.")] = 1.0,
    start_hour: Annotated[float, typer.Option(min=0, max=24, help="Hour of the day to start at.")] = 8.0,
    seed: Annotated[int, typer.Option(help="Same seed, same weather, same plants.")] = 0,
    turnaround_ms: Annotated[float, typer.Option(min=0, max=1000, help="Time a controller takes to answer.")] = 15.0,
    link_dir: Annotated[
        Path | None,
        typer.Option(exists=True, file_okay=False, writable=True, help="Make a symlink NAME to each pty there."),
    ] = None,
    oracle: Annotated[
        bool, typer.Option("--oracle", help="Registers that encode device and address, instead of a solar day.")
    ] = False,
    model: Annotated[str, typer.Option(help="Model of the controllers for which none is named.")] = MODEL,
    tcp: Annotated[
        int | None,
        typer.Option(
            min=0,
            max=65535,
            help="Instead of ptys: a Modbus TCP server a line, on 127.0.0.1 from this port on, with the controllers "
            "on an EIA-485 bus behind it; 0 takes free ports.",
        ),
    ] = None,
    close_after_reply: Annotated[
        bool,
        typer.Option("--close-after-reply", help="With --tcp: close a connection after each reply."),
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one line of JSON instead of a table.")] = False,
) -> None:
    """Run simulated controllers on ptys paced at 9600 8N2, or behind Modbus TCP servers, and print where they are."""
    try:
        _check(tcp, link_dir, closes=close_after_reply)
        plans = _plans(line, lines, devices)
        _check_ports(tcp or 0, len(plans))
        behaviour = Behaviour(seed, speed, start_hour, turnaround_ms / 1000, oracle)
        site = SimulatedSite.build(load_map(model), plans, behaviour, link_dir)
    except (ValueError, MapError) as error:
        raise typer.BadParameter(str(error)) from error
    try:
        asyncio.run(_run(site, as_json) if tcp is None else _run_tcp(site, tcp, as_json, closes=close_after_reply))
    except OSError as error:
        what = "make a pty" if tcp is None else "listen"
        Console(stderr=True).print(f"cannot {what}: {error}", markup=False)
        raise typer.Exit(1) from error


def _check(tcp: int | None, link_dir: Path | None, *, closes: bool) -> None:
    if tcp is None and closes:
        raise ValueError("--close-after-reply needs --tcp")
    if tcp is not None and link_dir is not None:
        raise ValueError("--tcp and --link-dir exclude each other")


def _check_ports(first: int, lines: int) -> None:
    if first + lines - 1 > HIGHEST_PORT:
        raise ValueError(f"--tcp {first} leaves no ports for {lines} lines; the highest is {HIGHEST_PORT}")


def _plans(line: list[str] | None, lines: int | None, devices: int) -> tuple[LinePlan, ...]:
    if line and lines is not None:
        raise ValueError("--line and --lines exclude each other")
    if line:
        return tuple(LinePlan.parse(text) for text in line)
    if lines is None:
        return DEMO_LAYOUT
    return tuple(LinePlan(f"line-{k + 1}", tuple(range(1, devices + 1))) for k in range(lines))


async def _run_tcp(site: SimulatedSite, first: int, as_json: bool, *, closes: bool) -> None:
    """The controllers of the site's lines behind servers; its ptys are never opened."""
    stopped = stop_event((signal.SIGINT, signal.SIGTERM))
    habits = Habits(closes=closes)
    buses = [SimulatedServer(port.line.stations, habits=habits, bus=port.line.timing) for port in site.lines]
    servers = [TcpServer(bus, port=first + number if first else 0) for number, bus in enumerate(buses)]
    try:
        for server in servers:
            await server.open()
        _announce(site, [server.url for server in servers], as_json)
        await stopped.wait()
    finally:
        for server in servers:
            server.close()
    for plan, server in zip(site.plans, servers, strict=True):
        seen = server.server.counters
        print(
            f"line={plan.name} connections={seen.connections} requests={seen.requests} replies={seen.replies}"
            f" most_waiting={seen.most_waiting}",
            file=sys.stderr,
        )


async def _run(site: SimulatedSite, as_json: bool) -> None:
    stopped = stop_event((signal.SIGINT, signal.SIGTERM))
    site.open()
    opened_at = asyncio.get_running_loop().time()
    try:
        _announce(site, [line.path for line in site.lines], as_json)
        await stopped.wait()
    finally:
        site.close()
    _sum_up(site, asyncio.get_running_loop().time() - opened_at)


def _sum_up(site: SimulatedSite, elapsed_s: float) -> None:
    """Tell on standard error what each line saw; a gap violation is a client that waited less than 3.5 characters."""
    for plan, port in zip(site.plans, site.lines, strict=True):
        seen = port.line.counters
        print(
            f"line={plan.name} requests={seen.requests} replies={seen.replies} bad_frames={seen.bad_frames}"
            f" gap_violations={seen.gap_violations} collisions={seen.collisions}"
            f" shortest_gap_ms={seen.shortest_gap_s * 1000:.2f} use={port.line.use_ratio(elapsed_s):.1%}",
            file=sys.stderr,
        )


def _announce(site: SimulatedSite, ports: Sequence[str], as_json: bool) -> None:
    """Tell the ports: a table for people, or one line of JSON for programs.

    It is `{"lines": [{"name", "port", "addresses", "models"}]}`, addresses and models in the same order.
    """
    if as_json:
        listed = [
            {
                "name": plan.name,
                "port": port,
                "addresses": list(plan.addresses),
                "models": [unit.map.model for unit in _units(site, number)],
            }
            for number, (plan, port) in enumerate(zip(site.plans, ports, strict=True))
        ]
        print(json.dumps({"lines": listed}), flush=True)
        return
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for heading in ("line", "port", "addresses"):
        table.add_column(heading)
    for plan, port in zip(site.plans, ports, strict=True):
        units = (
            f"{address}:{plan.models[address]}" if address in plan.models else str(address)
            for address in plan.addresses
        )
        table.add_row(plan.name, port, ", ".join(units))
    console = Console()
    console.print(table)
    address, at = site.plans[0].addresses[0], urlsplit(ports[0])
    how = "-m rtu -b 9600 -P none -s 2" if at.port is None else f"-m tcp -p {at.port}"
    where = at.path if at.port is None else at.hostname
    example = f"mbpoll {how} -a {address} -t 4:hex -0 -r 0 -c 82 -1 {where}"
    console.print(f"Try: {example}", markup=False, soft_wrap=True, highlight=False)
    console.print("Ctrl-C ends it.")


def _units(site: SimulatedSite, number: int) -> Sequence[Controller]:
    """The controllers of a line."""
    before = sum(len(plan.addresses) for plan in site.plans[:number])
    return site.controllers[before : before + len(site.plans[number].addresses)]
