"""`prostar-gateway scan`: which controllers are on a line, as tables for the configuration.

What is found goes to standard output as TOML, the progress bar and everything else to standard error.
"""

from __future__ import annotations

import json
import re
import signal
import threading
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal
from urllib.parse import urlsplit

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, TextColumn, TimeRemainingColumn

from gateway.core.settings import LineSettings, UpstreamSettings
from gateway.errors import PortError
from gateway.lines.looking import Found, ScanStopped
from gateway.lines.ports import close_port, open_port
from gateway.lines.scan import Scanner
from gateway.lines.scan_tcp import TcpScanner

HIGHEST_ADDRESS = 247
TIMEOUT_S = 0.2
TCP_TIMEOUT_S = 2.0
"""The server's own wait for a controller is in it."""


def command(
    port: Annotated[
        str,
        typer.Argument(
            metavar="PORT",
            help="A device path, rfc2217://host:port, socket://host:port, or tcp://host:port for a Modbus TCP server.",
        ),
    ],
    *,
    baudrates: Annotated[str, typer.Option(metavar="N,N…", help="Speeds to try.")] = "9600",
    addresses: Annotated[str, typer.Option(metavar="A-B,C…", help="Addresses to ask.")] = f"1-{HIGHEST_ADDRESS}",
    timeout_s: Annotated[
        float | None,
        typer.Option(
            min=0.02, max=10.0, help="How long a controller may take to answer; left out: 0.2, through tcp:// 2."
        ),
    ] = None,
    parity: Annotated[Literal["N", "E", "O"], typer.Option(help="None, even or odd.")] = "N",
    stopbits: Annotated[int, typer.Option(min=1, max=2, help="Stop bits.")] = 2,
) -> None:
    """Look for controllers on a line and print the tables that describe them. It only reads, never writes.

    The port must be free: stop the gateway first if it has it. Ctrl-C ends the scan and prints what was found.
    """
    try:
        speeds, wanted = _numbers(baudrates, 300, 230400), _numbers(addresses, 1, HIGHEST_ADDRESS)
    except ValueError as error:
        raise typer.BadParameter(str(error)) from None
    upstream = _upstream(port)
    if port.startswith("socket://") and len(speeds) > 1:
        raise typer.BadParameter("a socket:// port has the speed that its server was given; name one")
    if "://" not in port:
        port = str(Path(port).absolute())  # what is printed is a configuration, which wants it so
    settings = LineSettings(
        name="scan", index=1, port=port, baudrate=speeds[0], parity=parity, stopbits=stopbits, upstream=upstream
    )
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda _number, _frame: stop.set())
    found: list[Found] = []
    if upstream is not None:
        trouble = _scan_tcp(upstream, wanted, timeout_s=timeout_s or TCP_TIMEOUT_S, stop=stop, found=found)
    else:
        trouble = _scan(settings, speeds, wanted, timeout_s=timeout_s or TIMEOUT_S, stop=stop, found=found)
    print(render(settings, found), end="")
    console = Console(stderr=True)
    console.print(trouble or f"{len(found)} found.", markup=False, highlight=False, soft_wrap=True)
    if stop.is_set():
        raise typer.Exit(128 + signal.SIGINT)
    raise typer.Exit(1 if trouble or not found else 0)


def _upstream(port: str) -> UpstreamSettings | None:
    """Where a `tcp://` port leads, None of any other; BadParameter for a URL that leads nowhere."""
    parts = urlsplit(port)
    if parts.scheme not in {"tcp", "socket", "rfc2217"}:
        return None
    try:
        host, number = parts.hostname, parts.port
    except ValueError:
        host = number = None
    if not host or not number:
        raise typer.BadParameter(f"{port} is not {parts.scheme}://host:port")
    return UpstreamSettings(host, number) if parts.scheme == "tcp" else None


def _scan_tcp(
    upstream: UpstreamSettings, units: Sequence[int], *, timeout_s: float, stop: threading.Event, found: list[Found]
) -> str:
    """As `_scan`, through a Modbus TCP server."""
    scanner = TcpScanner(upstream.host, upstream.port, timeout_s, stop.is_set)
    with Progress(*_columns(), console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("", total=len(units))
        at = "the first unit id"
        try:
            for done, step in enumerate(scanner.walk(units), start=1):
                at = f"unit id {step.address}"
                found += [step.found] if step.found is not None else []
                progress.update(task, completed=done, description=f"{at}, found {len(found)}")
        except ScanStopped:
            return f"Stopped after {at}; {len(found)} found until then."
        except PortError as error:
            return f"{upstream.host}:{upstream.port}: {error}"
        finally:
            scanner.close()
    return ""


def _columns() -> tuple[ProgressColumn, ...]:
    return (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())


def _scan(
    settings: LineSettings,
    speeds: Sequence[int],
    addresses: Sequence[int],
    *,
    timeout_s: float,
    stop: threading.Event,
    found: list[Found],
) -> str:
    """Fill `found`; gives why the scan did not come to its end, "" when it did."""
    try:
        port = open_port(settings)
    except PortError as error:
        return str(error)
    with Progress(*_columns(), console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("", total=len(speeds) * len(addresses))
        at = "the first address"
        try:
            for number, baudrate in enumerate(speeds):
                port.baudrate = baudrate
                timing = replace(settings, baudrate=baudrate).timing()
                for step in Scanner(port, timing, timeout_s, stop.is_set).walk(baudrate, addresses):
                    at = f"{baudrate} baud, address {step.address}"
                    found += [step.found] if step.found is not None else []
                    done = number * len(addresses) + addresses.index(step.address) + 1
                    progress.update(task, completed=done, description=f"{at}, found {len(found)}")
        except ScanStopped:
            return f"Stopped after {at}; {len(found)} found until then."
        except PortError as error:
            return f"{settings.port} failed after {at}: {error}"
        finally:
            close_port(port)
    return ""


def render(settings: LineSettings, found: Sequence[Found]) -> str:
    """What was found as TOML: a `[[line]]` table for each speed with its devices."""
    lines: list[str] = []
    speeds = sorted({each.baudrate for each in found})
    if len(speeds) > 1:
        lines.append("# Controllers answered at several speeds, but a line has one: set them to the same.")
    for baudrate in speeds:
        lines += ["[[line]]", f'name = "line-{baudrate}"' if len(speeds) > 1 else 'name = "line-1"']
        lines.append(f"port = {json.dumps(settings.port)}")
        if settings.upstream is None:
            lines += [f"baudrate = {baudrate}", f'parity = "{settings.parity}"', f"stopbits = {settings.stopbits}"]
        for each in sorted((one for one in found if one.baudrate == baudrate), key=lambda one: one.address):
            lines += ["", *_device(each)]
        lines.append("")
    return "\n".join(lines)


def _device(found: Found) -> Iterator[str]:
    damaged = "Its answers are damaged: two controllers with this address, noise, or another parity."
    said = found.identification
    if said is None and found.damaged:
        yield f"  # Something is at address {found.address}. {damaged}"
        return
    yield "  [[line.device]]"
    yield f'  name = "array-{found.address}"'
    yield f"  address = {found.address}"
    yield f"  unit_id = {found.address}"
    if found.model is not None and said is not None:
        yield f'  model = "{found.model}"'
        yield f"  product = {json.dumps(said.product)}"
    else:
        yield '  # model = "…"  # it does not say that it is one with a map'
    if found.serial_number is not None:
        yield f"  serial_number = {json.dumps(found.serial_number)}"
    if said is not None:
        text = f"{said.vendor} {said.product} {said.revision}"
        yield f"  # It says: {re.sub(r'[^ -~]', '?', text)}"
    if found.damaged:
        yield f"  # {damaged}"


def _numbers(text: str, least: int, most: int) -> list[int]:
    """The numbers of `1-5,9`, each once, in their order; ValueError says what is wrong."""
    numbers: dict[int, None] = {}
    for part in text.split(","):
        match = re.fullmatch(r"\s*(\d{1,6})(?:-(\d{1,6}))?\s*", part)
        if match is None:
            raise ValueError(f"{text!r} is no list of numbers or ranges such as 1-5,9")
        first, last = int(match[1]), int(match[2] or match[1])
        if not least <= first <= last <= most:
            raise ValueError(f"{part.strip()} is not within {least} to {most}")
        numbers.update(dict.fromkeys(range(first, last + 1)))
    return list(numbers)
