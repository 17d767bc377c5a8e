"""One client alone on a line, reading 82 registers as often as it can: `line_clients.py KIND PORT SECONDS`.

KIND is `asyncio` or `uvloop` (the gateway's line on that loop), `pymodbus-async` or `pymodbus-sync`. Prints one line of
JSON: reads, seconds, the median of a read, CPU seconds.
"""

from __future__ import annotations

import asyncio
import json
import statistics
import sys
import time
from collections.abc import Callable

from pymodbus.client import AsyncModbusSerialClient, ModbusSerialClient

from gateway.clock import SystemClock
from gateway.core.settings import LineSettings, PollSettings
from gateway.core.site import Device, Outcome
from gateway.core.snapshot import DeviceState
from gateway.devices.schema import load_map
from gateway.lines.serial import SerialLine
from gateway.modbus.pdu import ReadRequest

REGISTERS = 82
WARM_UP = 2


class Meter:
    """Counts reads from the second on that was started after the warm-up."""

    def __init__(self, seconds: float) -> None:
        self.seconds = seconds
        self.reads = -WARM_UP
        self.began = self.ended = self.cpu_began = 0.0
        self.took_s: list[float] = []

    def done(self) -> bool:
        """Count a read; True when that was the last."""
        self.reads += 1
        now = time.monotonic()
        if self.reads == 0:
            self.began, self.cpu_began = now, time.process_time()
        elif self.reads > 0:
            self.took_s.append(now - self.ended)
        self.ended = now
        return self.reads > 0 and now - self.began >= self.seconds

    def say(self) -> None:
        found = {
            "reads": self.reads,
            "seconds": self.ended - self.began,
            "median_s": statistics.median(self.took_s),
            "cpu_s": time.process_time() - self.cpu_began,
        }
        sys.stdout.write(json.dumps(found) + "\n")


async def gateway(port: str, meter: Meter) -> None:
    device = Device("array-1", 1, 1, load_map("prostar-mppt"))
    seldom = PollSettings(live_s=3600.0, settings_s=3600.0)
    line = SerialLine(LineSettings(name="line", index=1, port=port, poll=seldom), [device], SystemClock())
    running = asyncio.create_task(line.run())
    while device.snapshot.state is not DeviceState.ONLINE:  # noqa: ASYNC110  # the snapshot is replaced without an event
        await asyncio.sleep(0.05)
    await asyncio.sleep(1.0)  # the settings are read once
    ended = asyncio.Event()
    pdu = ReadRequest(3, 0, REGISTERS).encode()

    def ask() -> None:
        line.read(device, pdu, answered)

    def answered(outcome: Outcome) -> None:
        if not isinstance(outcome, bytes):
            sys.exit(f"read failed: {outcome}")
        if meter.done():
            ended.set()
        else:
            ask()

    ask()
    await ended.wait()
    meter.say()
    running.cancel()


async def pymodbus_async(port: str, meter: Meter) -> None:
    client = AsyncModbusSerialClient(port, baudrate=9600, bytesize=8, parity="N", stopbits=2)
    await client.connect()
    while True:
        reply = await client.read_holding_registers(0, count=REGISTERS, device_id=1)
        if reply.isError():
            sys.exit(f"read failed: {reply}")
        if meter.done():
            break
    meter.say()
    client.close()


def pymodbus_sync(port: str, meter: Meter) -> None:
    client = ModbusSerialClient(port, baudrate=9600, bytesize=8, parity="N", stopbits=2)
    client.connect()
    while True:
        reply = client.read_holding_registers(0, count=REGISTERS, device_id=1)
        if reply.isError():
            sys.exit(f"read failed: {reply}")
        if meter.done():
            break
    meter.say()


def with_uvloop(port: str, meter: Meter) -> None:
    import uvloop

    uvloop.run(gateway(port, meter))


KINDS: dict[str, Callable[[str, Meter], None]] = {
    "asyncio": lambda port, meter: asyncio.run(gateway(port, meter)),
    "uvloop": with_uvloop,
    "pymodbus-async": lambda port, meter: asyncio.run(pymodbus_async(port, meter)),
    "pymodbus-sync": pymodbus_sync,
}

if __name__ == "__main__":
    KINDS[sys.argv[1]](sys.argv[2], Meter(float(sys.argv[3])))
