"""One of the servers of bench_metrics.py: `metrics_server.py gateway|peer 80|prostar`.

It prints its port, then obeys lines on its standard input. `change` gives every live value of every device a new
number, as if all had been polled, and is answered `done`; `held` is answered with the longest time, in milliseconds,
for which the loop was held since it was asked last (0 where there is no loop).
"""

from __future__ import annotations

import asyncio
import random
import sys
import time
from collections.abc import Callable
from types import MappingProxyType

from prometheus_client import CollectorRegistry, Gauge, GCCollector, ProcessCollector, start_http_server
from prometheus_client.parser import text_string_to_metric_families

from gateway.clock import SystemClock
from gateway.core.site import Device, LineState, LineStatus, Outcome, Site, Ticket
from gateway.core.snapshot import DeviceState, Snapshot
from gateway.core.stats import LineStats, ModbusServerStats
from gateway.devices.model import DeviceMap, Group, IdentityRules, Point, Space, Value
from gateway.devices.schema import load_map
from gateway.faces.http.app import HttpFace
from gateway.faces.http.exposition import Exposition
from gateway.faces.http.own import Counts
from gateway.faces.http.settings import HttpSettings
from gateway.faces.http.text import TEXT
from gateway.service.loops import Loop, loop_factory

DEVICES = 200
TICK_S = 0.001


class NoLine:
    """A line that nobody asks."""

    name = "shelter-a"
    index = 1
    port = ""
    stats = LineStats()

    def status(self, now: float) -> LineStatus:
        return LineStatus(LineState.OPEN, now, "", 0, 0.96)

    def read(
        self, device: Device, pdu: bytes, done: Callable[[Outcome], None], *, client: str = "", background: bool = False
    ) -> Ticket:
        raise AssertionError(device)

    def write(self, device: Device, pdu: bytes, done: Callable[[Outcome], None], *, client: str = "") -> Ticket:
        raise AssertionError(device)


def eighty_values() -> DeviceMap:
    """A model of 80 measured values and nothing else."""
    like = load_map("prostar-mppt").point("battery_voltage")
    points = tuple(
        Point(
            **{
                **{name: getattr(like, name) for name in Point.__slots__},
                "name": f"value_{number}",
                "metric": f"morningstar_value_{chr(97 + number // 26)}{chr(97 + number % 26)}_volts",
            }
        )
        for number in range(80)
    )
    no_identity = IdentityRules((), (), "", None, 0)
    return DeviceMap(
        "eighty", "Eighty", "", {3: Space.REGISTERS}, {}, (), (), points, {}, {}, log=None, identity=no_identity
    )


class Controllers:
    """A site of online devices that all have a value for every point."""

    def __init__(self, device_map: DeviceMap) -> None:
        self.clock = SystemClock()
        self.devices = [Device(f"array-{unit}", unit, unit, device_map) for unit in range(1, DEVICES + 1)]
        for device in self.devices:
            device.line = NoLine()
        self.site = Site.of("ridge-07", [NoLine()], self.devices)
        self.change()

    def change(self) -> None:
        """New snapshots; live numbers are others than before."""
        for device in self.devices:
            values: dict[str, Value] = {}
            for point in device.map.points:
                measured = point.group is Group.LIVE and point.enumeration is None and point.bits is None
                values[point.name] = round(random.uniform(10, 15) * 128) / 128 if measured else 1
            now = self.clock.monotonic()
            old = device.snapshot
            device.snapshot = Snapshot(
                old.version + 1, DeviceState.ONLINE, last_reply_at=now, values=MappingProxyType(values)
            )


def say(text: str) -> None:
    """Tell who asked."""
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


async def serve_gateway(controllers: Controllers) -> None:
    face = HttpFace(
        HttpSettings(listen=(("127.0.0.1", 0),)),
        controllers.site,
        controllers.clock,
        modbus=ModbusServerStats(),
        snmp=dict,
        not_ready=tuple,
    )
    [listener] = face.listeners
    await listener.start()
    assert listener.bound is not None
    say(str(listener.bound[1]))
    loop = asyncio.get_running_loop()
    longest_s = 0.0

    async def tick() -> None:
        nonlocal longest_s
        while True:
            before = time.perf_counter()
            await asyncio.sleep(TICK_S)
            longest_s = max(longest_s, time.perf_counter() - before - TICK_S)

    ended = asyncio.Event()

    def obey() -> None:
        nonlocal longest_s
        line = sys.stdin.readline().strip()
        if line == "change":
            controllers.change()
            say("done")
        elif line == "held":
            say(f"{longest_s * 1000:.2f}")
        else:
            ended.set()
        longest_s = 0.0

    loop.add_reader(sys.stdin.fileno(), obey)
    ticking = asyncio.create_task(tick())
    await ended.wait()
    ticking.cancel()
    await listener.stop()


def serve_peer(controllers: Controllers) -> None:
    """The same series as ready-made gauges: the peer need not name, decode or leave out anything."""
    exposition = Exposition(controllers.site, controllers.clock, Counts())
    registry = CollectorRegistry()
    gauges: dict[str, Gauge] = {}
    live: list[tuple[Gauge, Device, str]] = []
    by_unit = {str(device.unit_id): device for device in controllers.devices}
    points = {point.metric: point.name for point in controllers.devices[0].map.points}
    for family in text_string_to_metric_families(asyncio.run(_joined(exposition)).decode()):
        for sample in family.samples:
            if sample.name.startswith(("process_", "python_")):
                continue
            if sample.name not in gauges:
                gauges[sample.name] = Gauge(sample.name, family.documentation, list(sample.labels), registry=registry)
            gauge = gauges[sample.name]
            child = gauge.labels(**sample.labels) if sample.labels else gauge
            child.set(sample.value)
            if sample.name in points and not {"state", "bit"} & sample.labels.keys():
                live.append((child, by_unit[sample.labels["unit_id"]], points[sample.name]))
    ProcessCollector(registry=registry)
    GCCollector(registry=registry)
    server, thread = start_http_server(0, "127.0.0.1", registry)
    say(str(server.server_port))
    for line in sys.stdin:
        if line.strip() == "change":
            controllers.change()
            for child, device, name in live:
                child.set(device.snapshot.values[name])
            say("done")
        else:
            say("0")
    server.shutdown()
    server.server_close()
    thread.join()


async def _joined(exposition: Exposition) -> bytes:
    return b"".join([piece async for piece in exposition.pieces(TEXT)])


def main() -> None:
    """Serve until standard input ends."""
    which, size = sys.argv[1:]
    controllers = Controllers(eighty_values() if size == "80" else load_map("prostar-mppt"))
    if which == "peer":
        serve_peer(controllers)
        return
    with asyncio.Runner(loop_factory=loop_factory(Loop.AUTO)) as runner:
        runner.run(serve_gateway(controllers))


if __name__ == "__main__":
    main()
