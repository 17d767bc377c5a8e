"""An SNMP agent fed with any datagram, without sockets: whatever comes is answered or dropped, and counted once.

Used by its test with the hostile datagrams of F55, and by fuzz_snmp.py with atheris.
"""

from __future__ import annotations

import hashlib
from ipaddress import ip_network

from gateway.core.site import Device, Site
from gateway.core.stats import ModbusServerStats
from gateway.devices.schema import load_map
from gateway.faces.snmp.agent import SnmpAgent
from gateway.faces.snmp.settings import REPLY_LIMIT, Community, SnmpSettings
from tests.faces.snmp.poller import a_user
from tests.faces.snmp.stub_site import StubClock, StubLine, online

HOST = "127.0.0.1"


def agent() -> SnmpAgent:
    """One that speaks all versions about one controller, and has no limit of rates."""
    device_map = load_map("prostar-mppt")
    line = StubLine("shelter-a", 1, "/dev/ttyA")
    device = Device("array-1", 11, 1, device_map)
    device.line = line
    device.snapshot = online(device_map, 11)
    settings = SnmpSettings(
        listen=((HOST, 0),),
        communities=(Community("public", (ip_network("127.0.0.0/8"),)),),
        users=(a_user(),),
        v1=True,
        requests_per_s=1e9,
    )
    made = SnmpAgent(settings, Site.of("ridge-07", [line], [device]), StubClock(), ModbusServerStats())
    made.prepare()
    return made


def feed(to: SnmpAgent, data: bytes) -> None:
    """One datagram; AssertionError when the agent broke its word."""
    reply = to.answer(data, HOST)
    counters = to.counters
    assert counters.in_packets == counters.responses + counters.dropped
    assert counters.internal_errors == 0
    assert reply is None or 0 < len(reply) <= REPLY_LIMIT


def name(data: bytes) -> str:
    """What the file of an input is called in a corpus."""
    return hashlib.sha256(data).hexdigest()[:16]
