"""The gateway as a process over controllers that this process plays, so that a test decides when they answer."""

from __future__ import annotations

import asyncio
import contextlib
import signal
import socket
import struct
from collections.abc import AsyncIterator, Callable, Sequence
from pathlib import Path

from gateway.devices.schema import load_map
from gateway.modbus.rtu import Timing
from gateway.simulator.line import SimulatedLine
from gateway.simulator.oracle import OracleController
from gateway.simulator.pty import PtyLine
from tests.e2e.programs import GATEWAY, Program, Running, write_config

BAUDRATE = 115200
LINE_KEYS = f"baudrate = {BAUDRATE}\nreply_timeout_s = 3.0"
QUIET = "[poll]\nlive_s = 3600.0\nsettings_s = 3600.0\n[cache]\nmax_age_s = 0.1\n"
"""Polls only at the start and no memory, so that a test has the line to itself and every read needs it."""


class Unit(OracleController):
    """A controller that notes what it is asked, and may do one thing without saying so."""

    def __init__(self, number: int, address: int) -> None:
        super().__init__(load_map("prostar-mppt"), device=number, address=address)
        self.asked: list[bytes] = []
        self.never_answered = b""

    def handle(self, pdu: bytes, now: float) -> bytes | None:
        """See `Controller.handle`."""
        self.asked.append(pdu)
        reply = super().handle(pdu, now)
        return None if pdu == self.never_answered else reply

    async def is_asked(self, pdu: bytes) -> None:
        """Wait until this is on the wire."""
        await until(lambda: pdu in self.asked)

    async def is_quiet(self) -> None:
        """Wait until the polls of the start are over, so that the next request on the line is a client's."""
        async with asyncio.timeout(60):
            count = -1
            while count != len(self.asked):
                count = len(self.asked)
                await asyncio.sleep(0.5)


class NotifySocket:
    """The socket on which systemd listens."""

    def __init__(self, path: Path) -> None:
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(str(path))
        self._socket.setblocking(False)
        self.path = str(path)
        self.told: list[str] = []

    async def next(self, beginning: str, timeout_s: float = 60.0) -> str:
        """The next message that begins so."""
        async with asyncio.timeout(timeout_s):
            while True:
                message = (await asyncio.get_running_loop().sock_recv(self._socket, 4096)).decode()
                self.told.append(message)
                if message.startswith(beginning):
                    return message

    def drain(self) -> list[str]:
        """What was told and not yet looked at."""
        found: list[str] = []
        with contextlib.suppress(BlockingIOError):
            while True:
                found.append(self._socket.recv(4096).decode())
        return found

    def close(self) -> None:
        """End."""
        self._socket.close()


class Service:
    """One gateway process, its lines and its ports."""

    def __init__(self, folder: Path, ports: tuple[int, int, int]) -> None:
        self.folder = folder
        self.config = folder / "site.toml"
        self.ports = self.modbus, self.snmp, self.http = ports
        self.lines: dict[str, PtyLine] = {}
        self.units: dict[str, list[Unit]] = {}
        self.programs: list[Program] = []

    def plug(self, line: str, *addresses: int) -> None:
        """A line with controllers; each has registers of its own."""
        number = sum(map(len, self.units.values()))
        units = [Unit(number + index, address) for index, address in enumerate(addresses)]
        wire = SimulatedLine(units, timing=Timing.of(BAUDRATE, 8, "N", 2))
        self.units[line] = units
        self.lines[line] = PtyLine(wire, link=self.folder / line)
        self.lines[line].open()

    def configure(
        self,
        devices: Sequence[tuple[str, str, int, int]] = (("shelter-a", "array-1", 1, 11),),
        rest: str = QUIET,
        line_keys: str = LINE_KEYS,
        modbus_keys: str = "",
    ) -> None:
        """Write the configuration: line, name, address, unit id of each device."""
        write_config(self.config, self.ports, devices, line_keys, rest, modbus_keys=modbus_keys)

    def start(self, *arguments: str, **variables: str) -> Program:
        """Start the gateway."""
        self.programs.append(Program([*GATEWAY, "run", "-c", str(self.config), *arguments], **variables))
        return self.programs[-1]

    @property
    def site(self) -> Running:
        """The running gateway as the end-to-end tests see it."""
        return Running(self.folder, *self.ports, self.programs[-1], None)

    async def log(self, pattern: str, timeout_s: float = 60.0) -> str:
        """The next line of the log that matches."""
        return await asyncio.to_thread(self.programs[-1].wait_for, pattern, timeout_s)

    async def online(self, *devices: str) -> None:
        """Wait until these devices, or all, are online."""
        await asyncio.to_thread(self.site.wait_online, *devices, timeout_s=60.0)

    async def get(self, path: str) -> tuple[int, str]:
        """Status and text of an HTTP reply."""
        return await asyncio.to_thread(self.site.get, path)

    async def end(self, number: signal.Signals = signal.SIGTERM) -> int:
        """Send a signal and wait; the exit status."""
        return await asyncio.to_thread(self.programs[-1].end, number)

    async def ended(self) -> int:
        """Wait until it ends upon the signal that it was sent; the exit status."""
        return await asyncio.to_thread(self.programs[-1].ended)

    def close(self) -> None:
        """End every process and line."""
        for program in self.programs:
            if program.process.returncode is None:
                program.end(signal.SIGKILL)
        for line in self.lines.values():
            line.close()


class Client:
    """A Modbus TCP client that asks and waits as the test says."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._reader = reader
        self._writer = writer
        self._tid = 0

    def ask(self, unit: int, pdu: bytes) -> None:
        """Send a request."""
        self._tid += 1
        self._writer.write(self._tid.to_bytes(2) + b"\0\0" + (len(pdu) + 1).to_bytes(2) + bytes([unit]) + pdu)

    def send(self, data: bytes) -> None:
        """Send bytes as they are."""
        self._writer.write(data)

    def reset(self) -> None:
        """Be gone at once: RST instead of FIN, after which replies would still be sent."""
        sock = self._writer.get_extra_info("socket")
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self._writer.transport.abort()

    async def reply(self, timeout_s: float = 30.0) -> bytes:
        """The PDU of the next reply; b"" when the connection is over."""
        async with asyncio.timeout(timeout_s):
            try:
                header = await self._reader.readexactly(7)
                return await self._reader.readexactly(int.from_bytes(header[4:6]) - 1)
            except (asyncio.IncompleteReadError, ConnectionResetError):
                return b""

    async def read(self, unit: int, first: int = 0x12, count: int = 2, function: int = 3) -> bytes:
        """Ask for registers and wait."""
        self.ask(unit, read(first, count, function))
        return await self.reply()


def read(first: int = 0x12, count: int = 2, function: int = 3) -> bytes:
    """A read request."""
    return bytes([function]) + first.to_bytes(2) + count.to_bytes(2)


@contextlib.asynccontextmanager
async def client(port: int) -> AsyncIterator[Client]:
    """A connected client."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    try:
        yield Client(reader, writer)
    finally:
        writer.close()
        with contextlib.suppress(OSError):
            await writer.wait_closed()


async def until(condition: Callable[[], bool], timeout_s: float = 60.0) -> None:
    """Wait for a state that only the outside world brings about."""
    async with asyncio.timeout(timeout_s):
        while not condition():  # noqa: ASYNC110 - there is no event for it
            await asyncio.sleep(0.01)


def descriptors(pid: int) -> dict[str, str]:
    """The open files of a process."""
    folder = Path(f"/proc/{pid}/fd")
    found = {}
    for entry in folder.iterdir():
        with contextlib.suppress(OSError):
            found[entry.name] = str(entry.readlink())
    return found
