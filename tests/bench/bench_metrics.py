"""What a scrape costs: 200 ProStars through the HTTP face's collectors, against bare prometheus-client.

The peer holds the same series as ready-made gauges, so it does no decoding, no naming and no staleness.
Rounds are interleaved; medians are printed. `make bench` runs this; nothing passes or fails by it.
"""

from __future__ import annotations

import gzip
import statistics
import time
from collections.abc import Callable
from types import MappingProxyType

from prometheus_client import CollectorRegistry, Gauge
from prometheus_client.exposition import generate_latest
from prometheus_client.openmetrics.exposition import generate_latest as generate_openmetrics
from rich.console import Console
from rich.table import Table

from gateway.clock import SystemClock
from gateway.core.settings import LineSettings
from gateway.core.site import Device, Site
from gateway.core.snapshot import DeviceState, Snapshot
from gateway.devices.schema import load_map
from gateway.faces.http.devices import DeviceCollector
from gateway.lines.serial import SerialLine

DEVICES = 200
ROUNDS = 7


def make_site(clock: SystemClock) -> Site:
    """A line with 200 online controllers that have a value for every point."""
    device_map = load_map("prostar-mppt")
    devices = [Device(f"array-{unit}", unit, unit, device_map) for unit in range(1, DEVICES + 1)]
    line = SerialLine(LineSettings("shelter-a", 1, "/dev/null"), devices, clock)
    values = MappingProxyType({point.name: 12.625 if point.unit == "V" else 1 for point in device_map.points})
    for device in devices:
        device.snapshot = Snapshot(1, DeviceState.ONLINE, last_reply_at=clock.monotonic(), values=values)
    return Site.of("ridge-07", [line], devices)


def peer_registry(ours: CollectorRegistry) -> CollectorRegistry:
    """The same series as gauges of prometheus-client."""
    registry = CollectorRegistry()
    for family in ours.collect():
        if not family.samples:
            continue
        names = list(family.samples[0].labels)
        metric = Gauge(family.name, family.documentation, names, registry=registry)
        for sample in family.samples:
            metric.labels(**sample.labels).set(sample.value)
    return registry


def main() -> None:
    """Measure and print."""
    clock = SystemClock()
    ours = CollectorRegistry()
    ours.register(DeviceCollector(make_site(clock), clock))
    peer = peer_registry(ours)
    works: dict[str, Callable[[], object]] = {
        "prometheus-client, text": lambda: generate_latest(peer),
        "text": lambda: generate_latest(ours),
        "text, gzip": lambda: gzip.compress(generate_latest(ours), 1),
        "OpenMetrics": lambda: generate_openmetrics(ours),  # type: ignore[no-untyped-call]  # as upstream left it
    }
    times: dict[str, list[float]] = {name: [] for name in works}
    for _ in range(ROUNDS):
        for name, work in works.items():
            began = time.perf_counter()
            work()
            times[name].append(time.perf_counter() - began)
    medians = {name: statistics.median(taken) for name, taken in times.items()}
    series = sum(len(family.samples) for family in ours.collect())
    table = Table("reply", "median ms", "ratio to the peer", title=f"/metrics: {DEVICES} devices, {series} series")
    base = medians["prometheus-client, text"]
    for name, median in medians.items():
        table.add_row(name, f"{median * 1000:.1f}", f"{median / base:.2f}")
    Console().print(table)


if __name__ == "__main__":
    main()
