"""F61: a walk while snapshots change and a reload removes a device: in order, to the end, each row of one snapshot."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from random import Random

import pytest
from pysnmp.proto.api import v2c

from gateway.core.site import Device, Site
from gateway.core.snapshot import Snapshot
from gateway.core.stats import ModbusServerStats
from gateway.devices.model import DeviceMap
from gateway.faces.snmp.agent import SnmpAgent
from gateway.faces.snmp.settings import Oid
from tests.faces.snmp.poller import Poller, a_user
from tests.faces.snmp.stub_site import Ask, StubClock, online, stale
from tests.faces.snmp.test_responder import LIVE, LOCAL, Reply, request

START: Oid = (1, 3)
PRIVATE = "1.3.6.1.4.1.32473.1"
Step = Callable[[Oid], list[Oid]]


def change(site: Site, random: Random, version: int) -> None:
    """Something happens to one device."""
    device = random.choice(site.devices)
    full = online(device.map, device.unit_id)
    few = random.sample(list(full.values), 20)
    device.snapshot = random.choice(
        (
            replace(full, version=version, values={name: value + 1 for name, value in full.values.items()}),
            replace(full, version=version, values={name: full.values[name] for name in few}),
            stale(replace(full, version=version)),
            Snapshot(version=version),
        )
    )


def without(agent: SnmpAgent, site: Site, unit_id: int, clock: StubClock) -> SnmpAgent:
    """What a reload makes when the device is not in the configuration any more."""
    left = [device for device in site.devices if device.unit_id != unit_id]
    return SnmpAgent(agent.settings, Site.of(site.name, site.lines, left), clock, ModbusServerStats(), before=agent)


def steps(agent: SnmpAgent) -> dict[str, Step]:
    """What is behind an OID, by every kind of step; empty at the end."""
    poller = Poller(lambda data: agent.answer(data, LOCAL))
    poller.sign_in()

    def plain(kind: type, repetitions: int) -> Step:
        def step(at: Oid) -> list[Oid]:
            reply = Reply(agent.answer(request(kind, at, bulk=(0, repetitions)), LOCAL) or b"")
            assert reply.status == 0
            kinds = reply.kinds()
            return reply.names[: kinds.index("EndOfMibView") if "EndOfMibView" in kinds else None]

        return step

    def secure(at: Oid) -> list[Oid]:
        read = poller.ask(v2c.GetBulkRequestPDU, at, bulk=(0, 20))
        assert read is not None
        kinds = [type(value).__name__ for value in read.values]
        return read.names[: kinds.index("EndOfMibView") if "EndOfMibView" in kinds else None]

    bulk = v2c.GetBulkRequestPDU
    return {
        "getnext": plain(v2c.GetNextRequestPDU, 0),
        "getbulk-1": plain(bulk, 1),
        "getbulk-10": plain(bulk, 10),
        "getbulk-50": plain(bulk, 50),
        "v3 getbulk-20": secure,
    }


@pytest.fixture
def changing(make_agent: Callable[..., SnmpAgent]) -> SnmpAgent:
    agent = make_agent(users=(a_user(),), requests_per_s=1e9)
    agent.prepare()
    return agent


@pytest.mark.parametrize("way", ["getnext", "getbulk-1", "getbulk-10", "getbulk-50", "v3 getbulk-20"])
@pytest.mark.parametrize("seed", range(2))
def test_it_goes_up_and_ends(changing: SnmpAgent, site: Site, clock: StubClock, way: str, seed: int) -> None:
    random = Random(seed)
    step = steps(changing)[way]
    at, seen, removed = START, 0, False
    for version in range(2, 5000):
        if version % 3 == 0:
            change(site, random, version)
        if not removed and seen > 300:
            changing.adjust(without(changing, site, 12, clock))
            removed = True
        found = step(at)
        assert all(later > earlier for earlier, later in zip([at, *found], found, strict=False))
        assert not (removed and any(name[:-1] == (*LIVE, 9) and name[-1] == 12 for name in found))
        if not found:
            break
        seen += len(found)
        at = found[-1]
    else:
        pytest.fail("the walk does not end")
    assert removed
    assert changing.counters.internal_errors == 0


def at_version(device: Device, version: int) -> Snapshot:
    """Every measured value is the version."""
    full = online(device.map, device.unit_id)
    measured = {point.name for point in device.map.points if point.enumeration is None and point.bits is None}
    values = {name: version if name in measured else value for name, value in full.values.items()}
    return replace(full, version=version, values=values)


def columns_of(device_map: DeviceMap) -> Iterator[Oid]:
    for point in device_map.points:
        if point.mib is not None and point.mib.scale == 1000 and point.group == "live":
            yield (*LIVE, point.mib.column)


@pytest.mark.parametrize("kind", [v2c.GetRequestPDU, v2c.GetBulkRequestPDU])
def test_what_one_reply_says_of_a_device_is_of_one_snapshot(
    changing: SnmpAgent, site: Site, device_map: DeviceMap, kind: type
) -> None:
    """The same request again and again, so that the kept reply is renewed too."""
    columns = list(columns_of(device_map))[:20]
    names = [(*column, unit) for column in columns for unit in (11, 21)]
    asked = names if kind is v2c.GetRequestPDU else [(*names[0][:-1], 10), *(name[:-1] for name in names[2::2])]
    random = Random(1)
    for version in range(2, 40):
        device = site.by_unit[random.choice((11, 21))]
        device.snapshot = at_version(device, version)
        data = request(kind, *asked, bulk=(0, 1))
        reply = Reply(changing._responder.again(data, LOCAL, 1e6) or changing.answer(data, LOCAL) or b"")
        shown = {
            name: int(value.getComponent().getComponent())
            for name, value in zip(reply.names, reply.values, strict=True)
        }
        assert len(shown) >= 20
        for unit in (11, 21):
            of_unit = {value for name, value in shown.items() if name[-1] == unit}
            current = site.by_unit[unit].snapshot
            assert current.version == 1 or of_unit <= {current.version * 1000}


@pytest.mark.peer
async def test_net_snmp_walks_without_a_word(ask: Ask, agent: SnmpAgent, site: Site, clock: StubClock) -> None:
    random = Random(2)
    reload_after: list[int] = []  # packets; taken out once it is done

    async def changes() -> None:
        version = 1
        while True:
            version += 1
            change(site, random, version)
            if reload_after and agent.counters.in_packets > reload_after[0]:
                reload_after.clear()
                agent.adjust(without(agent, site, 21, clock))
            await asyncio.sleep(0)

    changer = asyncio.create_task(changes())
    try:
        for tool, *options in (("snmpwalk",), ("snmpbulkwalk", "-Cr10"), ("snmpbulkwalk", "-Cr50")):
            code, output = await ask(tool, *options, "1.3")
            assert code == 0
            assert "not increasing" not in output
            assert output.count("\n") > 200
        before = agent.tree
        reload_after.append(agent.counters.in_packets + 100)
        code, output = await ask("snmpwalk", PRIVATE)
        assert code == 0
        assert "not increasing" not in output
        assert not reload_after
        assert agent.tree is not before
    finally:
        changer.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await changer
