"""A site of fake lines with known snapshots, an agent on a free port, and net-snmp's tools to ask it."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable
from dataclasses import replace
from ipaddress import ip_network
from pathlib import Path

import pytest

from gateway.core.clients import ClientTable
from gateway.core.ratelimit import ClientRate
from gateway.core.site import Device, LineState, Site
from gateway.core.stats import ModbusServerStats
from gateway.devices.model import DeviceMap
from gateway.devices.schema import load_map
from gateway.faces.snmp.agent import SnmpAgent
from gateway.faces.snmp.log_table import LogDays, days_of
from gateway.faces.snmp.settings import Community, SnmpSettings
from gateway.generate.mib import mib_outputs
from tests.faces.snmp import stub_site
from tests.faces.snmp.stub_site import NOW, REPOSITORY, Ask, StubClock, StubLine, listening, online, run_tool


@pytest.fixture(scope="session")
def device_map() -> DeviceMap:
    return load_map("prostar-mppt")


@pytest.fixture
def site(device_map: DeviceMap) -> Site:
    """Two lines, two devices with address 1; 11 and 21 are online, 12, a TriStar, was never heard."""
    lines = (StubLine("shelter-a", 1, "/dev/ttyA"), StubLine("Hütte", 2, "/dev/ttyB", LineState.DOWN))
    devices = [
        Device("array-1", 11, 1, device_map),
        Device("array-2", 12, 2, load_map("tristar-mppt")),
        Device("array-3", 21, 1, device_map),
    ]
    for device, line in zip(devices, (lines[0], lines[0], lines[1]), strict=True):
        device.line = line
    devices[0].snapshot = online(device_map, 11)
    devices[2].snapshot = online(device_map, 21)
    return Site.of("ridge-07", lines, devices)


@pytest.fixture
def clock() -> StubClock:
    return StubClock()


@pytest.fixture
def modbus_stats() -> ModbusServerStats:
    stats = ModbusServerStats(connections=5, open_connections=2, requests=77, cache_hits=70, forwarded=7)
    stats.exceptions[0x0B] = 3
    stats.exceptions[0x02] = 4
    return stats


@pytest.fixture
def settings() -> SnmpSettings:
    loopback = (ip_network("127.0.0.0/8"), ip_network("::1/128"))
    return SnmpSettings(
        listen=(("127.0.0.1", 0),),
        communities=(Community("public", loopback), Community("elsewhere", (ip_network("192.0.2.0/24"),))),
        contact="noc@example.org",
        location="ridge",
    )


@pytest.fixture
def make_agent(
    site: Site, clock: StubClock, settings: SnmpSettings, modbus_stats: ModbusServerStats, device_map: DeviceMap
) -> Callable[..., SnmpAgent]:
    days = LogDays()
    days.put(11, days_of(device_map, stub_site.log(24, 48)))
    days.put(21, days_of(device_map, stub_site.log(24)))
    clients = ClientTable(ModbusServerStats(), 2.0)
    clients.arrived("192.0.2.7", ClientRate(), NOW)

    def make(give_way: Callable[[], None] = lambda: None, **changes: object) -> SnmpAgent:
        changed = replace(settings, **changes)  # type: ignore[arg-type]
        return SnmpAgent(changed, site, clock, modbus_stats, clients=clients, days=days, give_way=give_way)

    return make


@pytest.fixture
def agent(make_agent: Callable[..., SnmpAgent], clock: StubClock) -> SnmpAgent:
    """An agent that started 12.5 s ago."""
    made = make_agent()
    clock.now = NOW + 12.5
    return made


@pytest.fixture(scope="session")
def mib_path(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Where net-snmp finds the modules: freshly generated ones, and the stand-ins for the IETF's."""
    folder = tmp_path_factory.mktemp("mibs")
    for path, text in mib_outputs(locked="").items():
        (folder / Path(path).name).write_text(text, encoding="utf-8")
    return f"{folder}:{REPOSITORY / 'mibs' / 'base'}"


@pytest.fixture
async def ask(agent: SnmpAgent, peer: Callable[[str], str], mib_path: str) -> AsyncIterator[Ask]:
    """`code, output = await ask("snmpget", oid, ...)`: a net-snmp tool against `agent`."""
    async with listening(agent) as (host, port):
        at = f"[{host}]" if ":" in host else host

        async def run(tool: str, *arguments: str, options: tuple[str, ...] = ("-c", "public")) -> tuple[int, str]:
            known = ("-M", mib_path, "-m", "PROSTAR-GATEWAY-MIB", "-v", "2c", "-t", "2", "-r", "0")
            return await run_tool(peer(tool), *known, *options, f"udp:{at}:{port}", *arguments)

        yield run
