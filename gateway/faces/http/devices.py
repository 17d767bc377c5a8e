"""The controllers' values as metrics, by the names that the maps give.

Rules: a value is shown only while its device is online; the series of any other device are absent, so
that no line in a graph goes on flat. What says so (`morningstar_up`, the state, the age) is always there.

An enumeration is one series a state with the label `state`, 1 for the one that holds, else 0. A bit field is
one series a named bit with the label `bit`. A number or a set bit that the map does not name has a series
while it lasts (`value_17`, `bit_9`), so that it cannot pass unseen.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Protocol

from prometheus_client.metrics_core import Metric

from gateway.clock import Clock
from gateway.core.site import Device, Site
from gateway.core.snapshot import DeviceState
from gateway.devices.model import DeviceMap, Point, Value
from gateway.errors import MapError
from gateway.faces.http.metric import MetricInfo, MetricKind, Sample, gauge

DEVICE_LABELS = ("site", "line", "device", "unit_id", "model")
"""Every metric of a device has these labels, first and in this order."""

UP = gauge("morningstar_up", "1 while the controller is online, 0 while it is not.", *DEVICE_LABELS)
AGE = gauge(
    "morningstar_last_reply_age_seconds",
    "Time since the controller last answered; absent until it did.",
    *DEVICE_LABELS,
)
STATE = gauge(
    "morningstar_device_state",
    "1 for the state that the gateway has the controller in.",
    *DEVICE_LABELS,
    "state",
)
INFO = gauge(
    "morningstar_device_info",
    "What the controller said of itself, always 1; absent until it did.",
    *DEVICE_LABELS,
    "vendor",
    "product",
    "revision",
    "serial_number",
)
DEVICE_METRICS = (UP, AGE, STATE, INFO)
"""The metrics of a device that come from no register."""


def device_labels(site: Site, device: Device) -> tuple[str, ...]:
    """The values of `DEVICE_LABELS`."""
    return (site.name, device.line.name, device.name, str(device.unit_id), device.map.model)


def point_metric(point: Point) -> MetricInfo | None:
    """How a point is scraped, or None where the map makes no metric of it."""
    if point.metric is None:
        return None
    kind = MetricKind.COUNTER if point.metric.endswith("_total") else MetricKind.GAUGE
    labels: tuple[str, ...] = DEVICE_LABELS
    if point.enumeration is not None:
        labels = (*DEVICE_LABELS, "state")
    elif point.bits is not None:
        labels = (*DEVICE_LABELS, "bit")
    return MetricInfo(point.metric, kind, point.help, labels)


class _Series(Protocol):
    """The series of one point of one device."""

    def samples(self, value: Value) -> Iterable[Sample]:
        """The samples of the point's present value."""
        ...


class _Number:
    def __init__(self, labels: tuple[str, ...], scale: float) -> None:
        self._labels = labels
        self._scale = scale

    def samples(self, value: Value) -> Iterable[Sample]:
        return ((self._labels, value * self._scale),)


class _OneOf:
    def __init__(self, labels: tuple[str, ...], names: Mapping[int, str]) -> None:
        self._labels = labels
        self._states = {number: (*labels, name) for number, name in names.items()}

    def samples(self, value: Value) -> Iterator[Sample]:
        for number, labels in self._states.items():
            yield labels, float(number == value)
        if value not in self._states:
            yield (*self._labels, f"value_{int(value)}"), 1.0


class _Bits:
    def __init__(self, labels: tuple[str, ...], names: Mapping[int, str]) -> None:
        self._labels = labels
        self._bits = {number: (*labels, name) for number, name in names.items()}

    def samples(self, value: Value) -> Iterator[Sample]:
        bits = int(value)
        for number, labels in self._bits.items():
            yield labels, float(bits >> number & 1)
        for number in range(bits.bit_length()):
            if bits >> number & 1 and number not in self._bits:
                yield (*self._labels, f"bit_{number}"), 1.0


def _series(model: DeviceMap, point: Point, labels: tuple[str, ...]) -> _Series:
    if point.enumeration is not None:
        return _OneOf(labels, {entry.number: entry.name for entry in model.enumerations[point.enumeration]})
    if point.bits is not None:
        return _Bits(labels, {bit.number: bit.name for bit in model.bit_tables[point.bits]})
    return _Number(labels, point.metric_scale)


class DeviceCollector:
    """Collects every device of a site from its snapshot; never asks a line."""

    def __init__(self, site: Site, clock: Clock) -> None:
        """Prepare all series; MapError when two models give one metric name different labels or types."""
        self._clock = clock
        self._devices = [(device, device_labels(site, device)) for device in site.devices]
        self._infos: dict[str, MetricInfo] = {}
        self._series: dict[str, list[tuple[int, str, _Series]]] = {}  # metric → (index of device, point, its series)
        for index, (device, labels) in enumerate(self._devices):
            for point in device.map.points:
                self._add(index, device.map, labels, point)

    def _add(self, index: int, model: DeviceMap, labels: tuple[str, ...], point: Point) -> None:
        info = point_metric(point)
        if info is None:
            return
        known = self._infos.setdefault(info.name, info)
        if (known.kind, known.labels) != (info.kind, info.labels):
            raise MapError(f"{model.model}: point {point.name}: metric {info.name} has other labels elsewhere")
        self._series.setdefault(info.name, []).append((index, point.name, _series(model, point, labels)))

    def collect(self) -> Iterator[Metric]:
        """All metrics that have a sample now; each device's from one snapshot."""
        now = self._clock.monotonic()
        seen = [(device.snapshot, labels) for device, labels in self._devices]
        yield UP.family((labels, float(snapshot.state is DeviceState.ONLINE)) for snapshot, labels in seen)
        yield AGE.family(
            (labels, max(0.0, now - snapshot.last_reply_at))
            for snapshot, labels in seen
            if snapshot.last_reply_at is not None
        )
        yield STATE.family(
            ((*labels, state.value), float(snapshot.state is state))
            for snapshot, labels in seen
            for state in DeviceState
        )
        yield INFO.family(
            ((*labels, says.vendor, says.product, says.revision, snapshot.serial_number or ""), 1.0)
            for snapshot, labels in seen
            if (says := snapshot.identification) is not None
        )
        shown = [snapshot.shown() for snapshot, _ in seen]
        for name, entries in self._series.items():
            samples: list[Sample] = []
            for index, point, series in entries:
                value = shown[index].get(point)
                if value is not None:
                    samples.extend(series.samples(value))
            if samples:
                yield self._infos[name].family(samples)
