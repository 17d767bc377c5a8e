"""A real gateway over lines that go wrong, with clients of all faces; every value that comes back is judged.

The gateway is a process. Lines, chaos, oracles and clients live here, in one event loop, so that the oracles know what
they were asked and when.
"""

from __future__ import annotations

import asyncio
import contextlib
import subprocess
import time
from collections import Counter
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from random import Random

from gateway.clock import SystemClock
from gateway.modbus import mbap
from gateway.modbus.rtu import Timing
from gateway.simulator.chaos import Chaos, Fault
from gateway.simulator.line import SimulatedLine
from gateway.simulator.oracle import Verdict
from gateway.simulator.pty import PtyLine
from tests.e2e.programs import GATEWAY, Program, environment
from tests.faults.rig import Unit, read

BAUDRATE = 115200
MAX_AGE_S = 3.0
LINES = {"shelter-a": (1, 2), "shelter-b": (1,)}
EXCEPTIONS = {0x04, 0x06, 0x0A, 0x0B}
AWAY_S = {Fault.CLOSE: 0.0, Fault.UNPLUG: 0.5}


class Site:
    """Lines, units and the gateway's ports; `running` opens it."""

    def __init__(self, folder: Path, seed: int, rates: dict[Fault, float], ports: tuple[int, int, int]) -> None:
        self.folder = folder
        self.modbus, self.snmp, self.http = ports
        self.units: dict[int, Unit] = {}
        self.chaos: list[Chaos] = []
        self.lines: list[PtyLine] = []
        self.clock = SystemClock()
        for number, (name, addresses) in enumerate(LINES.items()):
            units = [Unit(len(self.units) + k, address) for k, address in enumerate(addresses)]
            self.units |= {11 + unit.device: unit for unit in units}
            chaos = Chaos(seed + number, rates)
            line = PtyLine(
                SimulatedLine(units, timing=Timing.of(BAUDRATE, 8, "N", 2), medium=chaos), link=folder / name
            )
            chaos.on_port_fault = self._port_fault(line)
            self.chaos.append(chaos)
            self.lines.append(line)

    def _port_fault(self, line: PtyLine) -> Callable[[Fault], None]:
        def happen(fault: Fault) -> None:
            loop = asyncio.get_running_loop()
            loop.call_soon(line.unplug)
            loop.call_later(AWAY_S[fault], line.replug)

        return happen

    def configure(self) -> Path:
        """Write the configuration; live values a second apart, so that every path through the cache is taken."""
        text = f'site = "soak"\nstate_dir = "{self.folder / "state"}"\n'
        for name, addresses in LINES.items():
            text += f'[[line]]\nname = "{name}"\nport = "{self.folder / name}"\nbaudrate = {BAUDRATE}\n'
            text += "reply_timeout_s = 0.2\n"
            for address in addresses:
                unit = next(
                    number
                    for number, each in self.units.items()
                    if each.address == address and (number == 13) == (name == "shelter-b")
                )
                text += f'[[line.device]]\nname = "array-{unit - 10}"\naddress = {address}\nunit_id = {unit}\n'
                text += 'model = "prostar-mppt"\n'
        text += f'[cache]\nmax_age_s = {MAX_AGE_S}\n[modbus]\nlisten = ["127.0.0.1:{self.modbus}"]\n'
        text += f'[http]\nlisten = ["127.0.0.1:{self.http}"]\n[snmp]\nlisten = ["127.0.0.1:{self.snmp}"]\n'
        text += '[[snmp.community]]\nname = "public"\nsource = ["127.0.0.0/8"]\n'
        path = self.folder / "site.toml"
        path.write_text(text)
        return path


class Client:
    """One Modbus TCP client that comes and goes; every reply is judged."""

    def __init__(self, site: Site, seed: int) -> None:
        self.site = site
        self.codes: Counter[int] = Counter()  # 0: a reply with data
        self.wrong: list[str] = []
        self.slowest_s = 0.0
        self._rng = Random(seed)

    async def work(self, until: float) -> None:
        """Connect, read some hundred times, leave; until that moment of the monotonic clock."""
        while time.monotonic() < until:
            reader, writer = await asyncio.open_connection("127.0.0.1", self.site.modbus)
            try:
                for _ in range(self._rng.randint(1, 200)):
                    if time.monotonic() >= until:
                        break
                    await self._ask(reader, writer)
                    await asyncio.sleep(self._rng.choice((0.0, 0.01, 0.05)))
            finally:
                writer.close()
                with contextlib.suppress(OSError):
                    await writer.wait_closed()

    async def _ask(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        rng, site = self._rng, self.site
        unit = rng.choice((11, 12, 13))
        first = rng.choice((0x00, 0x08, 0x10, 0x40, 0xE000, 0x8000 + 16 * rng.randrange(200)))
        pdu = read(first, rng.choice((1, 2, 8, 16)), rng.choice((3, 4)))
        asked_at = site.clock.monotonic()
        writer.write(mbap.encode(7, unit, pdu))
        async with asyncio.timeout(60):
            head = await reader.readexactly(7)
            reply = await reader.readexactly(int.from_bytes(head[4:6], "big") - 1)
        self.slowest_s = max(self.slowest_s, site.clock.monotonic() - asked_at)
        if head[6] != unit:
            self.wrong.append(f"unit {head[6]} for {unit}")
        elif reply[0] & 0x80:
            self.codes[reply[1]] += 1
            if reply[1] not in EXCEPTIONS:
                self.wrong.append(f"exception {reply[1]} for {pdu.hex()} of unit {unit}")
        else:
            self.codes[0] += 1
            verdict = site.units[unit].judge_reply(pdu, reply, asked_at=asked_at, max_age_s=MAX_AGE_S)
            if verdict is not Verdict.RIGHT:
                self.wrong.append(f"{verdict}: {reply.hex()} for {pdu.hex()} of unit {unit}")


async def get(port: int, path: str) -> tuple[int, str]:
    """Status and text of an HTTP reply."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    try:
        writer.write(f"GET {path} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n".encode())
        async with asyncio.timeout(30):
            head, _, body = (await reader.read(-1)).partition(b"\r\n\r\n")
    finally:
        writer.close()
    return int(head.split()[1]), body.decode()


async def walk(site: Site, snmpbulkwalk: str) -> str:
    """All that the agent shows, by net-snmp."""
    process = await asyncio.create_subprocess_exec(
        snmpbulkwalk, "-m", "", "-v2c", "-c", "public", "-On", "-t5", f"127.0.0.1:{site.snmp}", "1.3.6.1",
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, env=environment(),
    )  # fmt: skip
    return (await process.communicate())[0].decode()


@contextlib.asynccontextmanager
async def running(site: Site) -> AsyncIterator[Program]:
    """Open the lines and start the gateway; it must end by SIGTERM with 0 afterwards."""
    for line in site.lines:
        line.open()
    gateway = Program((*GATEWAY, "run", "-c", str(site.configure()), "--log-level", "warning"))
    try:
        async with asyncio.timeout(30):
            while True:
                with contextlib.suppress(OSError):
                    if (await get(site.http, "/readyz"))[0] == 200:
                        break
                await asyncio.sleep(0.1)
        yield gateway
    finally:
        status = await asyncio.to_thread(gateway.end)
        for line in site.lines:
            line.close()
    assert status == 0
