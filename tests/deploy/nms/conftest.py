"""An agent with a device of every model, for the programs of others that are to read it by the delivered files."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass, replace
from ipaddress import ip_network
from pathlib import Path

import pytest

from gateway.core.site import Device, LineState, Site
from gateway.core.snapshot import Block
from gateway.core.stats import ModbusServerStats
from gateway.devices.model import Space
from gateway.devices.schema import load_map, models
from gateway.faces.snmp.agent import SnmpAgent
from gateway.faces.snmp.settings import Community, Emc1Device, SnmpSettings
from tests.faces.snmp.poller import a_user
from tests.faces.snmp.stub_site import NOW, StubClock, StubLine, listening, online

NMS = Path(__file__).parents[3] / "deploy" / "nms"
COMMUNITY = "k7-reader"
SILENT = 99


@dataclass(frozen=True)
class Plant:
    """A running agent and what it shows."""

    agent: SnmpAgent
    site: Site
    port: int

    @property
    def online(self) -> list[Device]:
        """The devices that answer: one of each model."""
        return [device for device in self.site.devices if device.unit_id != SILENT]


def a_site() -> Site:
    """Two lines; a device of each model that is online from unit id 11 on, and SILENT, which was never heard."""
    lines = (StubLine("shelter-a", 1, "/dev/ttyA"), StubLine("Hütte", 2, "/dev/ttyB", LineState.DOWN))
    devices = []
    for unit, model in enumerate(models(), start=11):
        device_map = load_map(model)
        device = Device(f"array-{unit - 10}", unit, 1, device_map)
        device.line = lines[unit % 2]
        block = Block(Space.REGISTERS, 0, 0x10000, b"", NOW)
        device.snapshot = replace(online(device_map, unit), blocks=(block,))
        devices.append(device)
    silent = Device("silent", SILENT, 2, load_map(models()[0]))
    silent.line = lines[0]
    return Site.of("ridge-07", lines, [*devices, silent])


@pytest.fixture
async def plant() -> AsyncIterator[Plant]:
    site, clock = a_site(), StubClock()
    loopback = (ip_network("127.0.0.0/8"),)
    settings = SnmpSettings(
        listen=(("127.0.0.1", 0),),
        communities=(Community(COMMUNITY, loopback),),
        users=(a_user("noc"),),
        emc1=(Emc1Device(11),),
        v1=True,
    )
    agent = SnmpAgent(settings, site, clock, ModbusServerStats(connections=5))
    clock.now = NOW + 12.5
    async with listening(agent) as (_, port):
        yield Plant(agent, site, port)


@pytest.fixture
def delivered() -> Callable[[str], str]:
    """`delivered("snmpd.conf")`: the text of a delivered file."""
    return lambda name: (NMS / name).read_text(encoding="utf-8")
