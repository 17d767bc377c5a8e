"""Three sites with ten controllers each behind one gateway: real gateways, real sockets, one loop.

Between the central gateway and each site there is a relay whose cable can be cut: nothing comes through any more, and
nobody is told.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import re
import subprocess
import time
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from gateway.clock import SystemClock
from gateway.core.snapshot import DeviceState
from gateway.devices.schema import load_map
from gateway.modbus.mbap import MbapSplitter, encode
from gateway.modbus.pdu import Function, ReadRequest
from gateway.modbus.rtu import Timing
from gateway.service.config import load_config, parse_config
from gateway.service.gateway import Gateway
from gateway.service.settings import line_sites
from gateway.simulator.device import SimulatedController
from gateway.simulator.line import SimulatedLine
from gateway.simulator.pty import PtyLine
from tests.machine import Stopwatch

CONFIG = Path(__file__).parents[2] / "config" / "concentrator.toml"
SITES = ("ridge-07", "ridge-08", "valley-02")
DEVICES = range(1, 11)
BAUDRATE = 115200
MAP = load_map("prostar-mppt")


@dataclass(eq=False)
class Relay:
    """A cable: TCP to `target` until it is cut."""

    target: int
    port: int = 0
    cut: bool = False
    writers: list[asyncio.StreamWriter] = field(default_factory=list)
    tasks: set[asyncio.Task[None]] = field(default_factory=set)
    listener: asyncio.Server | None = None

    async def open(self) -> None:
        self.listener = await asyncio.start_server(self._accept, "127.0.0.1", 0)
        self.port = self.listener.sockets[0].getsockname()[1]

    async def close(self) -> None:
        assert self.listener is not None
        self.listener.close()
        for writer in self.writers:
            writer.close()
        for task in self.tasks:
            task.cancel()
        await asyncio.gather(*self.tasks, return_exceptions=True)

    async def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.writers.append(writer)
        if self.cut:
            return
        try:
            far_reader, far_writer = await asyncio.open_connection("127.0.0.1", self.target)
        except OSError:
            writer.close()
            return
        self.writers.append(far_writer)
        for source, sink in ((reader, far_writer), (far_reader, writer)):
            task = asyncio.create_task(self._pump(source, sink))
            self.tasks.add(task)
            task.add_done_callback(self.tasks.discard)

    async def _pump(self, source: asyncio.StreamReader, sink: asyncio.StreamWriter) -> None:
        with contextlib.suppress(OSError):
            while data := await source.read(4096):
                if not self.cut:
                    sink.write(data)
            sink.close()


@dataclass(frozen=True, slots=True)
class Sites:
    """The central gateway, and the cables to the sites."""

    central: Gateway
    relays: dict[str, Relay]
    modbus: int
    snmp: int
    http: int

    def states(self, site: str) -> set[DeviceState]:
        return {device.snapshot.state for device in self.central.site.devices if device.line.name == site}


def site_config(name: str, port: Path, state_dir: Path) -> str:
    text = f'site = "{name}"\nstate_dir = "{state_dir}"\n[poll]\nlive_s = 0.8\n'
    text += '[modbus]\nlisten = ["127.0.0.1:0"]\n[snmp]\nlisten = []\n[http]\nlisten = []\n[history]\nenabled = false\n'
    text += f'[[line]]\nname = "bus"\nport = "{port}"\nbaudrate = {BAUDRATE}\n'
    for k in DEVICES:
        text += f'[[line.device]]\nname = "array-{k}"\naddress = {k}\nunit_id = {10 + k}\nmodel = "prostar-mppt"\n'
    return text


def central_config(relays: dict[str, Relay], state_dir: Path) -> str:
    """config/concentrator.toml, with the addresses of this test."""
    text = f'state_dir = "{state_dir}"\n' + CONFIG.read_text()
    for site, relay in relays.items():
        text, count = re.subn(rf'(name = "{site}"\nport = )"tcp://[^"]+"', rf'\1"tcp://127.0.0.1:{relay.port}"', text)
        assert count == 1
    text = text.replace("live_s = 2.0", "live_s = 0.5").replace("reply_timeout_s = 3.0", "reply_timeout_s = 1.0")
    for port in (1502, 1161, 9850):
        text = text.replace(f"127.0.0.1:{port}", "127.0.0.1:0")
    return text


async def until(condition: Callable[[], bool], limit_s: float = 30.0) -> None:
    async with asyncio.timeout(limit_s):
        while not condition():  # noqa: ASYNC110  # snapshots are replaced without an event
            await asyncio.sleep(0.02)


def bound(gateway: Gateway, face: str) -> int:
    listener = next(each for each in gateway.listeners if each.label.startswith(face))
    assert listener.bound is not None
    return listener.bound[1]


@contextlib.asynccontextmanager
async def running(folder: Path) -> AsyncIterator[Sites]:
    clock = SystemClock()
    stop = asyncio.Event()
    tasks: list[asyncio.Task[None]] = []
    relays: dict[str, Relay] = {}
    async with contextlib.AsyncExitStack() as stack:
        for number, name in enumerate(SITES):
            units = [SimulatedController(MAP, address=k, seed=100 * number + k, turnaround_s=0.002) for k in DEVICES]
            bus = SimulatedLine(units, timing=Timing.of(BAUDRATE, 8, "N", 2))
            await stack.enter_async_context(PtyLine(bus, link=folder / name))
            gateway = Gateway(parse_config(site_config(name, folder / name, folder / f"{name}.state")), clock)
            tasks.append(asyncio.create_task(gateway.run(stop)))
            await until(lambda gateway=gateway: gateway.listeners[0].bound is not None)  # type: ignore[misc]
            relays[name] = Relay(bound(gateway, "modbus"))
            await relays[name].open()
            stack.push_async_callback(relays[name].close)
        central = Gateway(parse_config(central_config(relays, folder / "central.state")), clock)
        tasks.append(asyncio.create_task(central.run(stop)))
        try:
            await until(lambda: all(each.bound is not None for each in central.listeners))
            ports = (bound(central, "modbus"), bound(central, "snmp"), bound(central, "http"))
            sites = Sites(central, relays, *ports)
            await until(lambda: all(sites.states(site) == {DeviceState.ONLINE} for site in SITES))
            yield sites
        finally:
            stop.set()
            await asyncio.gather(*tasks)


async def watch(sites: Sites, others: tuple[str, ...], seconds: float) -> tuple[float, float]:
    """Of the others' controllers the oldest live value and the time of a read, 95th percentiles, in seconds."""
    clock = SystemClock()
    devices = [device for device in sites.central.site.devices if device.line.name in others]
    reader, writer = await asyncio.open_connection("127.0.0.1", sites.modbus)
    oldest: list[float] = []
    times: list[float] = []
    end = clock.monotonic() + seconds
    k = 0
    while clock.monotonic() < end:
        device = devices[k % len(devices)]
        k += 1
        watch = Stopwatch()
        writer.write(encode(k & 0xFFFF, device.unit_id, ReadRequest(Function.READ_HOLDING_REGISTERS, 0, 80).encode()))
        [adu] = MbapSplitter().feed(await reader.readexactly(9 + 160))
        times.append(watch.s)
        assert (adu.tid, adu.unit, adu.pdu[0]) == (k & 0xFFFF, device.unit_id, 3)
        now = clock.monotonic()
        ages = [device.snapshot.age_s("battery_voltage", now) for device in devices]
        oldest.append(max(age for age in ages if age is not None))
        await asyncio.sleep(0.01)
    writer.close()
    return sorted(oldest)[int(0.95 * len(oldest))], sorted(times)[int(0.95 * len(times))]


def test_the_example_names_thirty_controllers_and_their_sites() -> None:
    config = load_config(CONFIG)
    assert sum(len(line.device) for line in config.line) == 30
    assert line_sites(config) == {site: site for site in SITES}


@pytest.mark.peer
async def test_one_site_cut_off_does_not_disturb_the_others(tmp_path: Path, peer: Callable[[str], str]) -> None:
    snmpwalk = peer("snmpwalk")
    async with running(tmp_path) as sites:
        others = SITES[1:]
        await watch(sites, others, 0.5)
        before_s, quick_s = await watch(sites, others, 2.0)

        sites.relays[SITES[0]].cut = True
        cut_at = time.monotonic()
        after_s, still_quick_s = await watch(sites, others, 3.0)
        await until(lambda: DeviceState.ONLINE not in sites.states(SITES[0]))
        figures = f"oldest value {before_s:.2f}, {after_s:.2f} s; p95 {1e3 * quick_s:.1f}, {1e3 * still_quick_s:.1f} ms"
        logging.getLogger(__name__).info(figures)
        assert all(sites.states(site) == {DeviceState.ONLINE} for site in others)
        assert after_s < 1.2 * before_s + 1.0  # ten controllers that wait for their time-outs would be many
        assert still_quick_s < 1.2 * quick_s + 0.02
        assert time.monotonic() - cut_at < 60

        lines = (await _fetch(sites.http, "/metrics")).splitlines()
        up = [line for line in lines if line.startswith("morningstar_up{")]
        assert len(up) == 30
        for site in SITES:
            mine = [line for line in up if f'site="{site}"' in line]
            assert len(mine) == 10
            assert all(f'line="{site}"' in line and f'device="{site}-array-' in line for line in mine)
            assert {line.rpartition(" ")[2] for line in mine} == {"0.0" if site == SITES[0] else "1.0"}
        column = "1.3.6.1.4.1.32473.1.1.2.1.3.1.28"
        walk = await asyncio.to_thread(
            subprocess.run,
            [snmpwalk, "-v2c", "-c", "k7-operations-reader", "-Oqv", f"127.0.0.1:{sites.snmp}", column],
            capture_output=True,
            text=True,
            check=True,
        )
        shown = [line.strip('"') for line in walk.stdout.split()]
        assert sorted(shown) == sorted(SITES * 10)

        sites.relays[SITES[0]].cut = False
        await until(lambda: sites.states(SITES[0]) == {DeviceState.ONLINE}, 75.0)


async def _fetch(port: int, path: str) -> str:
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    writer.write(f"GET {path} HTTP/1.0\r\nHost: central\r\n\r\n".encode())
    text = (await reader.read()).decode()
    writer.close()
    return text
