"""The same metrics by prometheus-client alone: written without a look at how the face writes them.

Values are taken from the snapshots by what the map says, numbers of the gateway from the rules, and everything else
(names of families, escaping, order, both formats) is left to prometheus-client.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import TypeVar

from prometheus_client import CollectorRegistry, GCCollector, ProcessCollector
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily
from prometheus_client.metrics_core import Metric

from gateway.clock import Clock
from gateway.core.histogram import Histogram
from gateway.core.site import Site
from gateway.core.snapshot import DeviceState
from gateway.devices.model import DeviceMap, Kind, Point, Value
from gateway.faces.http.devices import AGE, CONDITION, CONDITIONS, DEVICE_LABELS, INFO, STATE, UP, point_metric
from gateway.faces.http.history import DEVICE_HISTORY_RULES, STORE_RULES, DeviceHistoryView
from gateway.faces.http.lines import DEVICE_RULES, LINE_RULES, LineView
from gateway.faces.http.metric import Labels, MetricInfo, MetricKind
from gateway.faces.http.own import GATEWAY_RULES, HTTP_RULES, MODBUS_RULES, SNMP_RULES, Counts, GatewayView
from gateway.faces.http.rules import Rule

T = TypeVar("T")

Sample = tuple[Labels, float | Histogram]


def family(info: MetricInfo, samples: Iterable[Sample]) -> Metric:
    """One metric as prometheus-client has it."""
    # Its constructors append a unit to the name; ours has it already.
    made: CounterMetricFamily | GaugeMetricFamily | HistogramMetricFamily
    if info.kind is MetricKind.HISTOGRAM:
        made = HistogramMetricFamily(info.name, info.help, labels=info.labels)
        for labels, value in samples:
            assert isinstance(value, Histogram)
            bounds = ("+Inf" if bound == float("inf") else str(bound) for bound, _ in value.cumulative())
            made.add_metric(
                labels, list(zip(bounds, (n for _, n in value.cumulative()), strict=True)), sum_value=value.sum_s
            )
    else:
        kind = CounterMetricFamily if info.kind is MetricKind.COUNTER else GaugeMetricFamily
        made = kind(info.name, info.help, labels=info.labels)
        for labels, value in samples:
            assert not isinstance(value, Histogram)
            made.add_metric(labels, value)
    made.unit = info.unit
    return made


class Reference:
    """A collector of all metrics of a gateway but those of its process."""

    def __init__(self, site: Site, clock: Clock, counts: Counts, started_at: float) -> None:
        self._site = site
        self._clock = clock
        self._counts = counts
        self._started_at = started_at

    def collect(self) -> Iterator[Metric]:
        """All families that have a sample."""
        for info, samples in self._all():
            present = list(samples)
            if present:
                yield family(info, present)

    def _all(self) -> Iterator[tuple[MetricInfo, Iterable[Sample]]]:
        yield from self._status()
        yield from self._values()
        now, site, counts = self._clock.monotonic(), self._site, self._counts
        lines = [(LineView(line, line.status(now)), (line.name, site.name)) for line in site.lines]
        devices = [(device, self._labels()[index]) for index, device in enumerate(site.devices)]
        yield from _rules(GATEWAY_RULES, [(GatewayView(self._started_at, not counts.not_ready()), ())])
        yield from _rules(LINE_RULES, lines)
        yield from _rules(DEVICE_RULES, devices)
        yield from _rules(MODBUS_RULES, [(counts.modbus, ())])
        yield from _rules(SNMP_RULES, [(counts.snmp(), ())])
        yield from _rules(HTTP_RULES, [(counts.http, ())])
        if counts.history is not None:
            kept = counts.history.devices
            yield from _rules(STORE_RULES, [(counts.history, ())])
            yield from _rules(
                DEVICE_HISTORY_RULES,
                [
                    (DeviceHistoryView(kept[device.unit_id], now), labels)
                    for device, labels in devices
                    if device.unit_id in kept
                ],
            )

    def _labels(self) -> list[Labels]:
        return [
            tuple(
                {
                    "site": self._site.name,
                    "line": device.line.name,
                    "device": device.name,
                    "unit_id": f"{device.unit_id}",
                    "model": device.map.model,
                }[name]
                for name in DEVICE_LABELS
            )
            for device in self._site.devices
        ]

    def _status(self) -> Iterator[tuple[MetricInfo, Iterable[Sample]]]:
        now = self._clock.monotonic()
        seen = list(zip((device.snapshot for device in self._site.devices), self._labels(), strict=True))
        yield UP, [(labels, float(snapshot.state is DeviceState.ONLINE)) for snapshot, labels in seen]
        yield AGE, [(labels, now - at) for snapshot, labels in seen if (at := snapshot.last_reply_at) is not None]
        yield (
            STATE,
            [
                ((*labels, state.value), float(snapshot.state is state))
                for snapshot, labels in seen
                for state in DeviceState
            ],
        )
        yield (
            INFO,
            [
                ((*labels, says.vendor, says.product, says.revision, snapshot.serial_number or ""), 1.0)
                for snapshot, labels in seen
                if (says := snapshot.identification) is not None
            ],
        )
        yield (
            CONDITION,
            [
                ((*labels, condition), float(condition in snapshot.warnings))
                for snapshot, labels in seen
                for condition in sorted({*CONDITIONS, *snapshot.warnings})
            ],
        )

    def _values(self) -> Iterator[tuple[MetricInfo, Iterable[Sample]]]:
        infos: dict[str, MetricInfo] = {}
        samples: dict[str, list[Sample]] = {}
        for device, labels in zip(self._site.devices, self._labels(), strict=True):
            for point in device.map.points:
                info = point_metric(point)
                shown = device.snapshot.shown_texts() if point.kind is Kind.TEXT else device.snapshot.shown()
                value = shown.get(point.name)
                if info is not None and value is not None:
                    infos.setdefault(info.name, info)
                    samples.setdefault(info.name, []).extend(_point_samples(device.map, point, labels, value))
        for name, info in infos.items():
            yield info, samples[name]


def _point_samples(device_map: DeviceMap, point: Point, labels: Labels, value: Value | str) -> Iterator[Sample]:
    if isinstance(value, str):
        yield (*labels, value), 1.0
    elif point.enumeration is not None:
        names = {entry.number: entry.name for entry in device_map.enumerations[point.enumeration]}
        names.setdefault(int(value), f"value_{int(value)}")
        for number, name in names.items():
            yield (*labels, name), float(number == value)
    elif point.bits is not None:
        named = {bit.number: bit.name for bit in device_map.bit_tables[point.bits]}
        for number in range(64):
            is_set = bool(int(value) & (1 << number))
            if is_set or number in named:
                yield (*labels, named.get(number, f"bit_{number}")), float(is_set)
    else:
        yield labels, value * point.metric_scale


def _rules(
    rules: Iterable[Rule[T]], sources: Iterable[tuple[T, Labels]]
) -> Iterator[tuple[MetricInfo, Iterable[Sample]]]:
    known = list(sources)
    for rule in rules:
        yield rule.metric, [((*labels, *extra), value) for of, labels in known for extra, value in rule.read(of)]


class Process:
    """The process, with the units that its families' names end by."""

    def collect(self) -> Iterator[Metric]:
        for each in ProcessCollector(registry=None).collect():
            each.unit = MetricInfo(each.name, MetricKind.GAUGE, "").unit
            yield each


def registry(site: Site, clock: Clock, counts: Counts, started_at: float) -> CollectorRegistry:
    """A registry that renders what the face renders."""
    made = CollectorRegistry()
    made.register(Reference(site, clock, counts, started_at))
    made.register(Process())
    GCCollector(registry=made)
    return made
