"""The SNMP face over memory, Modbus TCP and HTTP beside it: `snmp_server.py PORT MODBUS_PORT HTTP_PORT asyncio|uvloop`.

200 devices, every point with a value, snapshots replaced every second as polls do. The community is "public"; the
user "bench" has SHA-256 and AES-128. The allowance of a source is out of the way; everything else is on.

SIGUSR1 prints a line: the longest CPU time, in milliseconds, that the SNMP face took in one turn of the event loop
since the last SIGUSR1.
"""

from __future__ import annotations

import asyncio
import logging
import signal
import sys
import time
from dataclasses import replace
from ipaddress import ip_network

from gateway.clock import SystemClock
from gateway.core.conditions import Conditions
from gateway.core.site import Device, Site
from gateway.core.snapshot import Block, DeviceState, Snapshot
from gateway.core.stats import ModbusServerStats
from gateway.devices.model import DeviceMap, Space, Value
from gateway.devices.schema import load_map
from gateway.faces.http.app import HttpFace
from gateway.faces.http.settings import HttpSettings
from gateway.faces.modbus.server import ModbusServer
from gateway.faces.modbus.settings import ModbusSettings
from gateway.faces.snmp.agent import SnmpAgent
from gateway.faces.snmp.datagrams import Datagrams
from gateway.faces.snmp.secret import Secret
from gateway.faces.snmp.settings import Community, SnmpSettings, User
from gateway.faces.snmp.usm import Auth, Credentials, Priv
from gateway.service.garbage import set_aside
from tests.bench.gateway_server import NoLine

UNITS = 200
MODEL = "prostar-mppt"
POLL_S = 1.0
DECODED = 100
LOOPBACK = (ip_network("127.0.0.0/8"),)
BENCH = Credentials(b"bench", Auth.SHA_256, Secret(b"authpass123"), Priv.AES_128, Secret(b"privpass123"))


def values(device_map: DeviceMap, number: int) -> dict[str, Value]:
    """A value for every point, different from poll to poll."""
    return {
        point.name: device_map.enumerations[point.enumeration][0].number
        if point.enumeration
        else 1
        if point.bits
        else 10 + (number + position) % 100 / 8
        for position, point in enumerate(device_map.points)
    }


class Turns:
    """Measures the turns of an agent."""

    def __init__(self, agent: SnmpAgent) -> None:
        self._answer_waiting = agent.answer_waiting
        self._longest_s = 0.0

    def answer_waiting(self, sock: Datagrams, context: bytes = b"") -> None:
        """One turn."""
        before = time.thread_time()
        self._answer_waiting(sock, context)
        self._longest_s = max(self._longest_s, time.thread_time() - before)

    def tell(self) -> None:
        """Print the longest turn and begin anew."""
        sys.stdout.write(f"{self._longest_s * 1000:.3f}\n")
        sys.stdout.flush()
        self._longest_s = 0.0


async def serve(port: int, modbus_port: int, http_port: int) -> None:
    clock = SystemClock()
    line = NoLine()
    device_map = load_map(MODEL)
    devices = [Device(f"unit-{unit}", unit, unit, device_map) for unit in range(1, UNITS + 1)]
    for device in devices:
        device.line = line
        device.snapshot = Snapshot(state=DeviceState.ONLINE, last_reply_at=clock.monotonic())
    site, stats = Site.of("bench", [line], devices), ModbusServerStats()
    settings = SnmpSettings(
        listen=(("127.0.0.1", port),),
        communities=(Community("public", LOOPBACK),),
        users=(User(BENCH, LOOPBACK),),
        requests_per_s=1e9,
    )
    conditions = Conditions(site, (), clock.monotonic())
    modbus = ModbusServer(ModbusSettings(listen=(("127.0.0.1", modbus_port),)), site, clock, stats)
    agent = SnmpAgent(settings, site, clock, stats, conditions=conditions, give_way=modbus.hub.serve)
    turns = Turns(agent)
    agent.answer_waiting = turns.answer_waiting  # type: ignore[method-assign]
    asyncio.get_running_loop().add_signal_handler(signal.SIGUSR1, turns.tell)
    http = HttpFace(
        HttpSettings(listen=(("127.0.0.1", http_port),)), site, clock, modbus=stats, snmp=dict, not_ready=tuple
    )
    number = 0
    data = b"".join(at.to_bytes(2) for at in range(0x52))
    decoded = [values(device_map, at) for at in range(DECODED)]  # what decoding costs is not the face's
    await modbus.listeners[0].start()
    await agent.listeners[0].start()
    await http.listeners[0].start()
    set_aside()  # as the gateway does once it has started
    while True:
        number += 1
        conditions.look(clock.monotonic())  # as its keeper does
        for device in devices:
            now = clock.monotonic()
            block = Block(Space.REGISTERS, 0, 0x52, data, now)
            found = decoded[(number + device.unit_id) % DECODED]
            device.snapshot = replace(
                device.snapshot,
                version=number,
                blocks=(block,),
                last_reply_at=now,
                values=found,
                read_at=dict.fromkeys(found, now),
            )
            await asyncio.sleep(POLL_S / UNITS if number > 1 else 0)


if __name__ == "__main__":
    logging.basicConfig(level=logging.ERROR)  # that a poller signs in would be told amid the tables
    serving = serve(int(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]))
    if sys.argv[4] == "uvloop":
        import uvloop

        uvloop.run(serving)
    else:
        asyncio.run(serving)
