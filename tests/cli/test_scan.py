"""`scan` on simulated lines: what it finds, what it sends, and how it ends."""

from __future__ import annotations

import asyncio
import fcntl
import os
import signal
import sys
import termios
import tomllib
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
from typer.testing import CliRunner

from gateway.cli.app import app
from gateway.cli.scan import _numbers, render
from gateway.core.settings import LineSettings
from gateway.devices.model import DeviceMap, Identification
from gateway.devices.schema import load_map
from gateway.errors import ConfigError
from gateway.lines.looking import Found
from gateway.modbus.rtu import Timing
from gateway.service.config import parse_config
from gateway.simulator.device import SimulatedController
from gateway.simulator.line import SimulatedLine, Station
from gateway.simulator.medium import Burst, CleanMedium
from gateway.simulator.oracle import OracleController
from gateway.simulator.pty import PtyLine
from gateway.simulator.tcp import TcpServer
from gateway.simulator.upstream import Habits, SimulatedServer

MAP: DeviceMap = load_map("prostar-mppt")
FAST = 115200
SPEEDS = {9600: termios.B9600, 19200: termios.B19200, 115200: termios.B115200}


class Wire(CleanMedium):
    """A wire that notes every request, is deaf at another speed than its own, and may be noisy."""

    def __init__(self, baudrate: int, noise: bytes = b"") -> None:
        self.requests: list[bytes] = []
        self.port: PtyLine | None = None
        self._baudrate = baudrate
        self._noise = noise

    def request(self, frame: bytes, ended_at: float) -> bytes:
        assert self.port is not None
        assert self.port._slave is not None
        self.requests.append(frame)
        right = termios.tcgetattr(self.port._slave)[4] == SPEEDS[self._baudrate]
        return super().request(frame, ended_at) if right else b""

    def echo(self, frame: bytes, started_at: float) -> Sequence[Burst]:
        return (Burst(started_at, self._noise),) if self._noise else ()


class Unnamed(OracleController):
    """A device that says nothing to Read Device Identification."""

    def handle(self, pdu: bytes, now: float) -> bytes | None:
        return None if pdu[0] == 0x2B else super().handle(pdu, now)


class Stranger(OracleController):
    """A device without a map."""

    def identification(self) -> dict[int, bytes]:
        return {0: b"Acme \xff", 1: b'Sun "X"', 2: b"1"}


@asynccontextmanager
async def wired(folder: Path, wire: Wire, *stations: Station) -> AsyncIterator[PtyLine]:
    timing = Timing.of(wire._baudrate, 8, "N", 2)
    async with PtyLine(SimulatedLine(stations, timing=timing, medium=wire), link=folder / "line") as port:
        wire.port = port
        yield port


async def scanning(*arguments: str, cwd: str | None = None) -> asyncio.subprocess.Process:
    return await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "gateway", "scan", *arguments),
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
        cwd=cwd,
        env={**os.environ, "COLUMNS": "120"},
    )


async def scanned(*arguments: str, cwd: str | None = None) -> tuple[int | None, str, str]:
    process = await scanning(*arguments, cwd=cwd)
    async with asyncio.timeout(60):
        said, complained = await process.communicate()
    return process.returncode, said.decode(), complained.decode()


def addresses(toml: str) -> list[int]:
    return [device["address"] for device in tomllib.loads(toml)["line"][0]["device"]]


async def test_a_line_is_found_as_it_is_and_nothing_is_written(tmp_path: Path) -> None:
    wire = Wire(FAST)
    stations = (
        SimulatedController(MAP, address=3, serial_number="17410042", turnaround_s=0.002),
        Unnamed(MAP, device=1, address=5),
        Stranger(MAP, device=2, address=6),
        OracleController(MAP, device=3, address=8),
        OracleController(MAP, device=4, address=9),
        OracleController(MAP, device=5, address=9),  # the second controller with this address
    )
    async with wired(tmp_path, wire, *stations) as port:
        arguments = ("--baudrates", str(FAST), "--addresses", "1-4,5-9", "--timeout-s", "0.2")
        status, toml, said = await scanned(port.path.removeprefix("/"), *arguments, cwd="/")
    assert status == 0
    assert "5 found." in said
    assert addresses(toml) == [3, 5, 6, 8]
    assert "# Something is at address 9. Its answers are damaged: two controllers with this address" in toml
    line = tomllib.loads(toml)["line"][0]
    assert (line["port"], line["baudrate"]) == (port.path, FAST)
    by_address = {device["address"]: device for device in line["device"]}
    first = SimulatedController(MAP, address=3).plant.product
    expected = {"model": "prostar-mppt", "product": first, "serial_number": "17410042", "unit_id": 3}
    assert {key: by_address[3][key] for key in expected} == expected
    assert "model" not in by_address[5]
    assert "model" not in by_address[6]
    assert '# It says: Acme ? Sun "X" 1' in toml
    assert toml.count("damaged") == 1
    # What was identified is a configuration; what was not has to be named by somebody first.
    with pytest.raises(ConfigError) as caught:
        parse_config(f'site = "here"\n{toml}', "c")
    assert [problem.partition(";")[0] for problem in caught.value.problems] == [
        "c: line[0].device[1].model: is missing",
        "c: line[0].device[2].model: is missing",
    ]
    assert {request[1] for request in wire.requests} <= {0x01, 0x02, 0x03, 0x04, 0x2B}
    assert all(request[2] == 0x0E for request in wire.requests if request[1] == 0x2B)
    assert len(wire.requests) > 9
    assert all(not station.writes for station in stations)


async def test_the_speed_is_found_too(tmp_path: Path) -> None:
    wire = Wire(19200)
    async with wired(tmp_path, wire, OracleController(MAP, address=2)) as port:
        arguments = ("--baudrates", "9600,19200", "--addresses", "1-3", "--timeout-s", "0.2")
        status, toml, _ = await scanned(port.path, *arguments)
    assert status == 0
    config = parse_config(f'site = "here"\n{toml}')
    assert [(line.baudrate, [device.address for device in line.device]) for line in config.line] == [(19200, [2])]


@pytest.mark.parametrize("closes", [False, True])
async def test_the_controllers_behind_a_modbus_tcp_server_are_found_too(closes: bool) -> None:
    tristar = SimulatedController(load_map("tristar-mppt"), address=1, turnaround_s=0.002)
    stations = (tristar, Unnamed(MAP, device=1, address=5, turnaround_s=0.002))
    habits = Habits(closes=closes, silence=None if closes else 0x0B, patience_s=0.01)
    async with TcpServer(SimulatedServer(stations, habits=habits)) as server:
        status, toml, said = await scanned(server.url, "--addresses", "1-6", "--timeout-s", "0.5")
    assert status == 0
    assert "2 found." in said
    line = tomllib.loads(toml)["line"][0]
    assert (line["port"], addresses(toml)) == (server.url, [1, 5])
    assert line["device"][0]["product"] == tristar.plant.product
    named = toml.partition('\n\n  [[line.device]]\n  name = "array-5"')[0]
    assert parse_config(f'site = "here"\n{named}').line[0].device[0].model == "tristar-mppt"
    assert not tristar.writes


async def test_a_server_that_is_not_there_or_has_no_port_is_said(free_tcp_port: Callable[[], int]) -> None:
    port = free_tcp_port()
    status, toml, said = await scanned(f"tcp://127.0.0.1:{port}")
    assert (status, toml) == (1, "")
    assert f"127.0.0.1:{port}: connection refused" in said
    assert (await scanned("tcp://127.0.0.1"))[0] == 2


async def test_a_late_answer_is_asked_for_again_with_patience(tmp_path: Path) -> None:
    slow = OracleController(MAP, address=2, turnaround_s=0.4)
    async with wired(tmp_path, Wire(FAST), slow) as port:
        arguments = ("--baudrates", str(FAST), "--addresses", "1-3", "--timeout-s", "0.3")
        status, toml, _ = await scanned(port.path, *arguments)
    assert (status, addresses(toml)) == (0, [2])
    assert tomllib.loads(toml)["line"][0]["device"][0]["model"] == "prostar-mppt"


async def test_noise_is_nobody_and_nobody_is_status_1(tmp_path: Path) -> None:
    async with wired(tmp_path, Wire(FAST, noise=b"\x00\xff\x01\x03\x55" * 3)) as port:
        arguments = ("--baudrates", str(FAST), "--addresses", "1-4", "--timeout-s", "0.2")
        assert (await scanned(port.path, *arguments))[:2] == (1, "")


async def test_a_controller_is_found_through_noise(tmp_path: Path) -> None:
    async with wired(tmp_path, Wire(FAST, noise=b"\x00\xff\x55"), OracleController(MAP, address=2)) as port:
        arguments = ("--baudrates", str(FAST), "--addresses", "1-3", "--timeout-s", "0.2")
        status, toml, _ = await scanned(port.path, *arguments)
    assert (status, addresses(toml)) == (0, [2])


async def test_ctrl_c_prints_what_was_found_until_then(tmp_path: Path) -> None:
    wire = Wire(FAST)
    async with wired(tmp_path, wire, OracleController(MAP, address=2), OracleController(MAP, address=200)) as port:
        process = await scanning(port.path, "--baudrates", str(FAST), "--timeout-s", "0.2")
        async with asyncio.timeout(30):
            while not any(request[0] == 5 for request in wire.requests):  # noqa: ASYNC110  # the wire has no event
                await asyncio.sleep(0.01)
        process.send_signal(signal.SIGINT)
        async with asyncio.timeout(30):
            said, complained = await process.communicate()
    assert process.returncode == 130
    assert addresses(said.decode()) == [2]
    assert b"1 found until then." in complained
    assert b"Traceback" not in complained


async def test_a_port_in_use_is_refused_with_its_holders_name(tmp_path: Path) -> None:
    wire = Wire(FAST)
    async with wired(tmp_path, wire, OracleController(MAP, address=1)) as port:
        held = os.open(port.path, os.O_RDWR | os.O_NOCTTY)
        fcntl.flock(held, fcntl.LOCK_EX)
        status, said, complained = await scanned(port.path)
        os.close(held)
    assert (status, said) == (1, "")
    assert f"(process {os.getpid()})" in complained.replace("\n", "")
    assert wire.requests == []


async def test_a_port_that_goes_away_ends_the_scan_with_what_was_found(tmp_path: Path) -> None:
    wire = Wire(FAST)
    async with wired(tmp_path, wire, OracleController(MAP, address=2)) as port:
        path = port.path
        process = await scanning(path, "--baudrates", str(FAST), "--timeout-s", "0.2")
        async with asyncio.timeout(30):
            while not any(request[0] == 4 for request in wire.requests):  # noqa: ASYNC110  # as above
                await asyncio.sleep(0.01)
        port.unplug()
        async with asyncio.timeout(30):
            said, complained = await process.communicate()
    assert process.returncode == 1
    assert addresses(said.decode()) == [2]
    assert f"{path} failed after {FAST} baud, address".encode() in complained
    assert b"Traceback" not in complained


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (("--addresses", "0-5"), "0-5 is not within 1 to 247"),
        (("--addresses", "9-5"), "9-5 is not within 1 to 247"),
        (("--addresses", "1,x"), "is no list of numbers"),
        (("--baudrates", "9600,1"), "1 is not within 300 to 230400"),
    ],
)
def test_what_cannot_be_asked_is_said(arguments: tuple[str, str], complaint: str) -> None:
    result = CliRunner(env={"COLUMNS": "200", "NO_COLOR": "1"}).invoke(app, ["scan", "/dev/null", *arguments])
    assert result.exit_code == 2
    assert complaint in result.stderr


@pytest.mark.parametrize("port", ["tcp://host", "tcp://host:70000", "socket://host", "socket://:1", "rfc2217://host:0"])
def test_a_port_that_leads_nowhere_is_said(port: str) -> None:
    result = CliRunner(env={"COLUMNS": "200", "NO_COLOR": "1"}).invoke(app, ["scan", port])
    assert result.exit_code == 2
    assert f"{port} is not {port.partition(':')[0]}://host:port" in result.stderr


def test_numbers_keep_their_order_and_come_once() -> None:
    assert _numbers("9600, 1-3,2", 1, 10000) == [9600, 1, 2, 3]


@pytest.mark.parametrize("product", ['a"b\\c', "\x00\x1b[31m\n]]", "日本"])
def test_whatever_a_device_says_the_output_is_toml(product: str) -> None:
    found = [
        Found(9600, 1, Identification(product, product, product), "prostar-mppt", "12"),
        Found(19200, 2, damaged=True),
    ]
    parsed = tomllib.loads(render(LineSettings(name="scan", index=1, port='/dev/"x'), found))
    assert parsed["line"][0]["device"][0]["product"] == product
    assert parsed["line"][0]["port"] == '/dev/"x'
