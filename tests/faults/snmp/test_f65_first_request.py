"""F65: the first request after a start is answered at once: everything is encoded and loaded before the port opens."""

from __future__ import annotations

import time
from collections.abc import Callable

import pytest
from pysnmp.proto.api import v2c

from gateway.core.site import Device, Site
from gateway.core.stats import ModbusServerStats
from gateway.devices.model import DeviceMap
from gateway.faces.snmp.agent import SnmpAgent
from gateway.faces.snmp.settings import SnmpSettings
from tests.faces.snmp.poller import AUTH_PRIV, Poller, a_user, pdu
from tests.faces.snmp.stub_site import StubClock, StubLine, online
from tests.faces.snmp.test_responder import LIVE, LOCAL, SYS_DESCR, Reply, request

LIMIT_S = 0.05
TURN_LIMIT_S = 0.005


def big(settings: SnmpSettings, device_map: DeviceMap, clock: StubClock) -> tuple[SnmpAgent, list[Device]]:
    """200 devices, all online."""
    line = StubLine("a", 1, "/dev/ttyA")
    devices = [Device(f"d{unit}", unit, unit, device_map) for unit in range(1, 201)]
    for device in devices:
        device.line = line
        device.snapshot = online(device_map, device.unit_id)
    return SnmpAgent(settings, Site.of("big", (line,), devices), clock, ModbusServerStats()), devices


@pytest.mark.parametrize(
    "first",
    [
        request(v2c.GetRequestPDU, SYS_DESCR),
        request(v2c.GetNextRequestPDU, (1, 3)),
        request(v2c.GetBulkRequestPDU, (*LIVE, 8), bulk=(0, 50)),
        request(v2c.SetRequestPDU, SYS_DESCR, value=v2c.OctetString(b"x")),
    ],
    ids=["get", "getnext", "getbulk", "set"],
)
def test_the_first_v2c_request(settings: SnmpSettings, device_map: DeviceMap, clock: StubClock, first: bytes) -> None:
    agent, _ = big(settings, device_map, clock)
    before = time.thread_time()
    assert agent.answer(first, LOCAL) is not None
    assert time.thread_time() - before < LIMIT_S


def test_the_first_v3_requests(make_agent: Callable[..., SnmpAgent]) -> None:
    agent = make_agent(users=(a_user(),))
    agent.prepare()  # keys are derived here, before the socket is bound
    spent: list[float] = []

    def exchange(data: bytes) -> bytes | None:
        before = time.thread_time()
        reply = agent.answer(data, LOCAL)
        spent.append(time.thread_time() - before)
        return reply

    poller = Poller(exchange)
    poller.sign_in()
    for kind in (v2c.GetRequestPDU, v2c.GetBulkRequestPDU):
        assert exchange(poller.sealed(pdu(kind, SYS_DESCR), AUTH_PRIV)) is not None
    assert max(spent) < LIMIT_S


def test_no_step_of_a_walk_of_200_devices_holds_the_loop(
    settings: SnmpSettings, device_map: DeviceMap, clock: StubClock
) -> None:
    """While devices come and go, all at once too, each step is bounded; time is the thread's own, not the machine's."""
    agent, devices = big(settings, device_map, clock)
    whole = [device.snapshot for device in devices]
    at: tuple[int, ...] = (1, 3)
    steps: list[float] = []
    cells = 0
    while True:
        if len(steps) % 40 == 20:
            for device in devices:
                device.snapshot = type(device.snapshot)()  # nobody was ever heard
        elif len(steps) % 40 == 22:
            for device, snapshot in zip(devices, whole, strict=True):
                device.snapshot = snapshot
        data = request(v2c.GetBulkRequestPDU, at, bulk=(0, 50))
        before = time.thread_time()
        reply = agent.answer(data, LOCAL)
        steps.append(time.thread_time() - before)
        assert reply is not None
        found = Reply(reply)
        assert all(later > earlier for earlier, later in zip((at, *found.names), found.names, strict=False)) or (
            found.kinds()[-1] == "EndOfMibView"
        )
        cells += len(found.names)
        if devices[0].snapshot is not whole[0]:
            continue  # over all of them in one step; the walk goes on when they are back
        if found.kinds()[-1] == "EndOfMibView":
            break
        at = found.names[-1]
    assert cells > 10_000
    steps.sort()
    assert steps[-1] < 10 * TURN_LIMIT_S  # a machine that was interrupted
    assert steps[int(len(steps) * 0.99)] < TURN_LIMIT_S
