"""Lines over the network: real ser2net (raw and RFC 2217) and socat in front of a simulated line on a pty."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import signal
import socket
import subprocess
import threading
from collections.abc import AsyncIterator, Callable, Iterator
from pathlib import Path

import pytest

from gateway.core.site import Device, LineState, Outcome
from gateway.core.snapshot import DeviceState
from gateway.devices.model import Space
from gateway.devices.schema import load_map
from gateway.errors import LineDown
from gateway.lines import serial as serial_module
from gateway.modbus.rtu import Timing
from gateway.simulator.line import SimulatedLine
from gateway.simulator.oracle import OracleController
from gateway.simulator.pty import PtyLine
from tests.lines.rig import ask, lag_meter, make_line, running, until
from tests.machine import Stopwatch

BAUDRATE = 115200
MOST_LAG_S = 0.25
"""A blocked loop shows itself in seconds; a busy machine in tenths of one."""

pytestmark = pytest.mark.filterwarnings("ignore:set(Daemon|Name)\\(\\) is deprecated:DeprecationWarning")

Peer = Callable[[str], str]
KINDS = ("ser2net raw", "ser2net rfc2217", "socat")


class Bridge:
    """A program between a TCP port and the pty."""

    def __init__(self, kind: str, device: str, port: int, peer: Peer, folder: Path) -> None:
        self.url = f"{'rfc2217' if kind.endswith('rfc2217') else 'socket'}://127.0.0.1:{port}"
        self._port = port
        if kind == "socat":
            listen = f"TCP-LISTEN:{port},bind=127.0.0.1,reuseaddr"
            self._command = [peer("socat"), listen, f"FILE:{device},raw,echo=0"]
        else:
            accepter = f"{'telnet(rfc2217),' if kind.endswith('rfc2217') else ''}tcp,127.0.0.1,{port}"
            config = folder / "ser2net.yaml"
            config.write_text(
                f"connection: &line\n  accepter: {accepter}\n  connector: serialdev,{device},{BAUDRATE}n82,local\n"
                "  options:\n    kickolduser: true\n"
            )
            self._command = [peer("ser2net"), "-n", "-u", "-c", str(config)]
        self.process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        self.process = subprocess.Popen(self._command, stdin=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    def end(self) -> None:
        if self.process is not None:
            self.process.send_signal(signal.SIGCONT)
            self.process.kill()
            self.process.wait()
            self.process = None


@pytest.fixture
def device() -> Device:
    return Device("array-1", 11, 1, load_map("prostar-mppt"))


@pytest.fixture
async def simulated(tmp_path: Path) -> AsyncIterator[PtyLine]:
    station = OracleController(load_map("prostar-mppt"), address=1, turnaround_s=0.002)
    async with PtyLine(SimulatedLine([station], timing=Timing.of(BAUDRATE, 8, "N", 2)), link=tmp_path / "line") as line:
        yield line


@pytest.fixture(params=KINDS)
def bridge(
    request: pytest.FixtureRequest, simulated: PtyLine, peer: Peer, free_tcp_port: Callable[[], int], tmp_path: Path
) -> Iterator[Bridge]:
    made = Bridge(request.param, os.path.realpath(simulated.path), free_tcp_port(), peer, tmp_path)
    made.start()
    yield made
    made.end()


@pytest.mark.peer
async def test_a_line_behind_a_terminal_server_is_lost_and_comes_back(bridge: Bridge, device: Device) -> None:
    async with running(make_line(bridge.url, device, baudrate=BAUDRATE)) as line, lag_meter() as lag:
        await until(lambda: device.snapshot.state is DeviceState.ONLINE)
        held = OracleController(load_map("prostar-mppt"), address=1).read(Space.REGISTERS, 8, 3, 0.0)
        words = b"".join(word.to_bytes(2, "big") for word in held)
        assert await ask(line, device, 8, 3) == b"\x03\x06" + words
        bridge.end()
        await until(lambda: line.status(0.0).state is LineState.DOWN)
        assert isinstance(await ask(line, device, 8), LineDown)
        bridge.start()
        await until(lambda: line.status(0.0).state is LineState.OPEN)
        await until(lambda: device.snapshot.state is DeviceState.ONLINE)
    assert lag.worst_s < MOST_LAG_S


@pytest.mark.peer
async def test_a_terminal_server_that_hangs_holds_nobody_up(bridge: Bridge, device: Device) -> None:
    outcomes: list[Outcome] = []
    line = make_line(bridge.url, device, baudrate=BAUDRATE, retries=0, queue_limit_s=0.5)
    async with running(line), lag_meter() as lag:
        await until(lambda: device.snapshot.state is DeviceState.ONLINE)
        assert bridge.process is not None
        bridge.process.send_signal(signal.SIGSTOP)
        outcomes.append(await ask(line, device, 8))
        await until(lambda: device.snapshot.state is not DeviceState.ONLINE)
        watch = Stopwatch()
    stopped_s = watch.s
    assert not isinstance(outcomes[0], bytes)
    assert lag.worst_s < MOST_LAG_S
    assert stopped_s < 3.0


@pytest.fixture
def silent_listener() -> Iterator[int]:
    """A port where connections are accepted by the kernel, and nobody ever says a word."""
    with socket.create_server(("127.0.0.1", 0), backlog=8) as server:
        yield server.getsockname()[1]


async def test_a_peer_that_never_negotiates_is_given_up_without_blocking(
    silent_listener: int, device: Device, caplog: pytest.LogCaptureFixture
) -> None:
    url = f"rfc2217://127.0.0.1:{silent_listener}?timeout=0.3"
    async with running(make_line(url, device)) as line, lag_meter() as lag:
        await until(lambda: "RFC2217" in line.status(0.0).error)
        assert isinstance(await ask(line, device, 0), LineDown)
    assert lag.worst_s < MOST_LAG_S
    assert sum("event=line_down" in message for message in caplog.messages) == 1


def descriptors() -> int:
    """How many this process has open."""
    return sum(1 for _ in Path("/proc/self/fd").iterdir())


@pytest.mark.parametrize("scheme", ["rfc2217", "socket"])
async def test_a_port_that_opens_after_its_line_was_stopped_is_closed(
    silent_listener: int, device: Device, scheme: str
) -> None:
    before, files = set(threading.enumerate()), descriptors()
    line = make_line(f"{scheme}://127.0.0.1:{silent_listener}", device)
    task = asyncio.create_task(line.run())
    await asyncio.sleep(0)  # its thread has started to open the port
    task.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await asyncio.wait_for(task, 30)
    await until(lambda: not set(threading.enumerate()) - before)
    await until(lambda: descriptors() == files)


@pytest.mark.parametrize("scheme", ["rfc2217", "socket"])
async def test_a_refused_connection_is_named(free_tcp_port: Callable[[], int], device: Device, scheme: str) -> None:
    url = f"{scheme}://127.0.0.1:{free_tcp_port()}"
    async with running(make_line(url, device)) as line:
        await until(lambda: line.status(0.0).error == f"{url}: connection refused")


async def test_a_connection_that_is_never_answered_is_named(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    import serial.urlhandler.protocol_socket as handler

    monkeypatch.setattr(handler, "POLL_TIMEOUT", 0.3)
    with socket.create_server(("127.0.0.1", 0), backlog=0) as full, contextlib.ExitStack() as stack:
        address = full.getsockname()
        for _ in range(4):  # more than the backlog holds: the kernel drops what comes after
            filler = stack.enter_context(socket.socket())
            filler.setblocking(False)
            filler.connect_ex(address)
        url = f"socket://127.0.0.1:{address[1]}"
        async with running(make_line(url, device)) as line, lag_meter() as lag:
            await until(lambda: line.status(0.0).error == f"{url}: no answer to the connection attempt")
        assert lag.worst_s < MOST_LAG_S


async def test_a_port_that_is_lost_again_and_again_is_no_news(
    device: Device, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(serial_module, "LAST_RETRY_S", 0.02)
    monkeypatch.setattr(serial_module, "SETTLE_S", 0.01)
    caplog.set_level(logging.INFO)
    accepted = 0

    async def hang_up(_reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        nonlocal accepted
        accepted += 1
        await asyncio.sleep(0.05 if accepted % 2 else 0)  # lost after it was up, and before
        writer.close()

    server = await asyncio.start_server(hang_up, "127.0.0.1", 0)
    port = server.sockets[0].getsockname()[1]
    async with running(make_line(f"socket://127.0.0.1:{port}", device)):
        await until(lambda: accepted >= 6)
    server.close()
    await server.wait_closed()
    assert sum("event=line_up" in message for message in caplog.messages) <= 1
    assert sum("event=line_down" in message for message in caplog.messages) <= 2
