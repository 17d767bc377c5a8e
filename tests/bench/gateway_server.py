"""The Modbus TCP face over memory: `gateway_server.py PORT asyncio|uvloop [REQUESTS_PER_S]`.

Everything of the face is on: routing, policy, freshness, snapshots replaced every second as polls do, access
list, limits, counters, and rate limits: 10 million requests a second and client, where no other rate is given.
Only the lines are missing: a read that memory cannot answer is counted as LineDown.
Register i of every unit holds i.
"""

from __future__ import annotations

import asyncio
import sys
from collections.abc import Callable
from dataclasses import replace

from gateway.clock import SystemClock
from gateway.core.ratelimit import ClientRate
from gateway.core.requests import Waiter
from gateway.core.site import Device, LineState, LineStatus, Outcome, Site
from gateway.core.snapshot import Block, DeviceState
from gateway.core.stats import LineStats, ModbusServerStats
from gateway.devices.model import Space
from gateway.devices.schema import load_map
from gateway.errors import LineDown
from gateway.faces.modbus.server import ModbusServer
from gateway.faces.modbus.settings import ModbusSettings, RateSettings

UNITS = 247
POLL_S = 1.0


class NoLine:
    """A line without a port."""

    name = "none"
    index = 1
    port = ""
    stats = LineStats()

    def status(self, now: float) -> LineStatus:
        return LineStatus(LineState.DOWN, now, "no port", 0, 0.0)

    def read(
        self, device: Device, pdu: bytes, done: Callable[[Outcome], None], *, client: str = "", background: bool = False
    ) -> Waiter:
        del device, pdu, background
        ticket = Waiter(done, client, 0.0)
        asyncio.get_running_loop().call_soon(ticket.finish, LineDown())
        return ticket

    def write(self, device: Device, pdu: bytes, done: Callable[[Outcome], None], *, client: str = "") -> Waiter:
        return self.read(device, pdu, done, client=client)


async def serve(port: int, requests_per_s: float) -> None:
    clock = SystemClock()
    line = NoLine()
    devices = [Device(f"unit-{unit}", unit, unit, load_map("prostar-mppt")) for unit in range(1, UNITS + 1)]
    for device in devices:
        device.line = line
    settings = ModbusSettings(
        listen=(("127.0.0.1", port),),
        max_connections=1024,
        max_per_client=1024,
        rate=RateSettings(ClientRate(requests_per_s), networks=()),
    )
    server = ModbusServer(settings, Site.of("bench", [line], devices), clock, ModbusServerStats())
    data = b"".join(at.to_bytes(2) for at in range(0x52))
    for listener in server.listeners:
        await listener.start()
    while True:
        for device in devices:
            block = Block(Space.REGISTERS, 0, 0x52, data, clock.monotonic())
            device.snapshot = replace(
                device.snapshot, version=device.snapshot.version + 1, state=DeviceState.ONLINE, blocks=(block,)
            )
            await asyncio.sleep(POLL_S / UNITS)


if __name__ == "__main__":
    main = serve(int(sys.argv[1]), float(sys.argv[3]) if len(sys.argv) > 3 else 1e7)
    if sys.argv[2] == "uvloop":
        import uvloop

        uvloop.run(main)
    else:
        asyncio.run(main)
