"""`prostar-gateway demo`: the main job on one screen, with simulated controllers on real ptys and a real TCP port.

The simulators and the gateway are other processes, started by the same commands that anybody would use
(`simulate`, `run`), and the picture is drawn from the gateway's own /metrics: nothing here looks behind the faces.

Rule 1: Ctrl-C, SIGTERM and a closed terminal end everything within two seconds, with exit status 0.
Rule 2: what cannot be done is said before anything is drawn: a taken port by its number and option.
"""

from __future__ import annotations

import signal
import socket
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from http.client import HTTPConnection, HTTPException
from pathlib import Path
from subprocess import Popen
from typing import Annotated

import typer
from rich.console import Console
from rich.live import Live

from gateway.cli.children import last_lines, start_gateway_command, stop_all
from gateway.cli.demo_commands import COMMUNITY, Try, commands_to_try
from gateway.cli.demo_screen import commands_text, fitting, plain_lines
from gateway.cli.demo_view import Rates, View, read_view
from gateway.cli.stopping import Stop

HOST = "127.0.0.1"
PROSTAR, TRISTAR = "prostar-mppt", "tristar-mppt"
LAYOUT = {
    "shelter-a": (("array-1", 1, 11, PROSTAR), ("array-2", 2, 12, PROSTAR)),
    "shelter-b": (("array-3", 1, 13, PROSTAR),),
    "hilltop": (("array-4", 1, 14, TRISTAR),),
}
"""Line → its controllers as (name, address, unit id, model): all three have one at the factory address."""

NETWORK = "hilltop"
"""The line that is a TriStar with a network of its own, which closes each connection after its reply."""

SIMULATION = ("--speed", "120", "--start-hour", "8")
"""A day in twelve minutes, from the morning on."""

REFRESH_S = 1.0
PLAIN_REFRESH_S = 5.0
START_S = 60.0


@dataclass(frozen=True, slots=True)
class Ports:
    """Where the three faces of the demo are, and the TriStar."""

    modbus: int
    snmp: int
    http: int
    tristar: int


class DemoError(Exception):
    """The demo cannot go on; the message is for people."""


def command(
    modbus_port: Annotated[int, typer.Option(min=1, max=65535, help="TCP port of the Modbus face.")] = 1502,
    snmp_port: Annotated[int, typer.Option(min=1, max=65535, help="UDP port of the SNMP face.")] = 1161,
    http_port: Annotated[int, typer.Option(min=1, max=65535, help="TCP port of the HTTP face.")] = 9850,
) -> None:
    """Run simulated controllers on two serial lines and a network, the gateway and its three faces, and watch them."""
    stop = Stop((signal.SIGINT, signal.SIGTERM, signal.SIGHUP))
    console = Console()
    ports = Ports(modbus_port, snmp_port, http_port, _free_port())
    try:
        _refuse_taken(ports)
        with tempfile.TemporaryDirectory(prefix="prostar-demo-") as folder, _children() as children:
            running = _Running(Path(folder), ports, children)
            running.start(console, stop)
            _show(running, ports, console, stop)
    except DemoError as error:
        print(error, file=sys.stderr)
        raise typer.Exit(1) from None


def _free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.bind((HOST, 0))
        port: int = probe.getsockname()[1]
        return port


def _refuse_taken(ports: Ports) -> None:
    wanted = (
        ("Modbus TCP", "--modbus-port", ports.modbus, socket.SOCK_STREAM),
        ("SNMP (UDP)", "--snmp-port", ports.snmp, socket.SOCK_DGRAM),
        ("HTTP", "--http-port", ports.http, socket.SOCK_STREAM),
    )
    problems = []
    for face, option, port, kind in wanted:
        with socket.socket(socket.AF_INET, kind) as probe:
            if kind is socket.SOCK_STREAM:
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((HOST, port))
            except OSError as error:
                problems.append(f"{face} port {HOST}:{port}: {error.strerror}. Choose another: {option} {port + 1}")
    if problems:
        raise DemoError("\n".join(problems))


@contextmanager
def _children() -> Iterator[list[Popen[bytes]]]:
    children: list[Popen[bytes]] = []
    try:
        yield children
    finally:
        stop_all(children)


class _Running:
    """The processes and the scrapes of the gateway."""

    def __init__(self, folder: Path, ports: Ports, children: list[Popen[bytes]]) -> None:
        self._folder = folder
        self._ports = ports
        self._children = children
        self._names: list[str] = []

    def start(self, console: Console, stop: Stop) -> None:
        """Start the simulator and the gateway; returns when all controllers are online, or a signal came."""
        serial = [line for line in LAYOUT if line != NETWORK]
        plans = [text for line in serial for text in ("--line", _plan(line))]
        self._spawn("simulate", "--link-dir", str(self._folder), *plans, *SIMULATION)
        network = ("--tcp", str(self._ports.tristar), "--close-after-reply", "--line", _plan(NETWORK), "--seed", "3")
        self._spawn("simulate", *network, *SIMULATION)
        links = [self._folder / line for line in serial]
        with console.status("Starting the simulated controllers …"):
            self._wait_for(lambda: all(link.exists() for link in links), stop, "the simulated lines to appear")
        config = self._folder / "demo.toml"
        config.write_text(demo_config(self._folder, self._ports))
        self._spawn("run", "-c", str(config))
        with console.status("Starting the gateway …"):
            self._wait_for(lambda: _all_online(self.scrape()), stop, "the controllers to answer")

    def scrape(self) -> View | None:
        """The view of now, or None when the gateway does not answer; DemoError when a process has ended."""
        self._check()
        connection = HTTPConnection(HOST, self._ports.http, timeout=0.5)
        try:
            connection.request("GET", "/metrics")
            return read_view(connection.getresponse().read().decode())
        except (OSError, HTTPException):
            return None
        finally:
            connection.close()

    def _spawn(self, name: str, *arguments: str) -> None:
        with self._log(len(self._children)).open("wb") as log:
            self._children.append(start_gateway_command([name, *arguments], log))
        self._names.append(name)

    def _check(self) -> None:
        for number, (child, name) in enumerate(zip(self._children, self._names, strict=True)):
            if child.poll() is not None:
                log = "\n".join(last_lines(self._log(number)))
                raise DemoError(f"prostar-gateway {name} ended with status {child.returncode}:\n{log}")

    def _log(self, number: int) -> Path:
        return self._folder / f"{number}.log"

    def _wait_for(self, condition: Callable[[], bool], stop: Stop, what: str) -> None:
        deadline = time.monotonic() + START_S
        while not condition():
            self._check()
            if time.monotonic() > deadline:
                raise DemoError(f"Waited {START_S:.0f} s for {what}.")
            if stop.wait(0.05):
                return


def _plan(line: str) -> str:
    """A line of the layout as `simulate` wants it."""
    return f"{line}=" + ",".join(f"{address}:{model}" for _, address, _, model in LAYOUT[line])


def _all_online(view: View | None) -> bool:
    return view is not None and all(device.quality == "online" for device in view.devices)


def demo_config(folder: Path, ports: Ports) -> str:
    """The configuration of the demo; the serial lines are the simulator's links in `folder`."""
    text = f'site = "demo"\nstate_dir = "{folder}"\n'
    for line, devices in LAYOUT.items():
        port = f"tcp://{HOST}:{ports.tristar}" if line == NETWORK else folder / line
        text += f'\n[[line]]\nname = "{line}"\nport = "{port}"\n'
        for name, address, unit, model in devices:
            text += f'[[line.device]]\nname = "{name}"\naddress = {address}\nunit_id = {unit}\nmodel = "{model}"\n'
    text += f'\n[modbus]\nlisten = ["{HOST}:{ports.modbus}"]\n\n[snmp]\nlisten = ["{HOST}:{ports.snmp}"]\n'
    text += f'[[snmp.community]]\nname = "{COMMUNITY}"\nsource = ["127.0.0.0/8"]\n'
    return text + f'\n[http]\nlisten = ["{HOST}:{ports.http}"]\n'


def _show(running: _Running, ports: Ports, console: Console, stop: Stop) -> None:
    commands = commands_to_try(ports.modbus, ports.snmp, ports.http, Path.cwd())
    if console.is_terminal:
        _show_tables(running, commands, console, stop)
    else:
        _show_lines(running, commands, stop)


def _show_tables(running: _Running, commands: Sequence[Try], console: Console, stop: Stop) -> None:
    rates = Rates()
    with Live(console=console, auto_refresh=False, vertical_overflow="crop") as live:
        while not stop.is_set:
            view = running.scrape()
            if view is not None:
                live.update(fitting(view, rates.add(view, time.monotonic()), commands, console), refresh=True)
            stop.wait(REFRESH_S)


def _show_lines(running: _Running, commands: Sequence[Try], stop: Stop) -> None:
    print(commands_text(commands, labels=True).plain, flush=True)
    rates = Rates()
    while not stop.is_set:
        view = running.scrape()
        if view is not None:
            print("\n".join(plain_lines(view, rates.add(view, time.monotonic()))), flush=True)
        stop.wait(PLAIN_REFRESH_S)
