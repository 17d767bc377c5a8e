"""The controllers' values as metrics, by the names that the maps give.

Rules: a value is shown only while its device is online; the series of any other device are absent, so
that no line in a graph goes on flat. What says so (`morningstar_up`, the state, the age) is always there.

An enumeration is one series a state with the label `state`, 1 for the one that holds, else 0. A bit field is
one series a named bit with the label `bit`. A number or a set bit that the map does not name has a series
while it lasts (`value_17`, `bit_9`), so that it cannot pass unseen. A text is one series of 1, with the text in a label
that is called as the point is.

Nothing of a scrape is kept for the next one: lines are written a family at a time, all devices at once (columns.py).
All lines of a scrape are of one moment.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

from gateway.core.site import Device, Site
from gateway.core.snapshot import IDENTITY_MISMATCH, NOT_REWRITTEN, UNKNOWN_MODEL, DeviceState, Snapshot
from gateway.devices.model import DeviceMap, Identification, Kind, Point
from gateway.errors import MapError
from gateway.faces.http.columns import Column, Shown, Tails, column_of, states
from gateway.faces.http.metric import Labels, MetricInfo, MetricKind, gauge
from gateway.faces.http.text import Lines, label_pairs, number

DEVICE_LABELS = ("device", "line", "model", "site", "unit_id")
"""Every metric of a device has these labels, first and in this order."""

CONDITIONS = (IDENTITY_MISMATCH, NOT_REWRITTEN, UNKNOWN_MODEL)
"""Conditions that have a series from the start, so that the first time is a rise."""

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
CONDITION = gauge(
    "morningstar_condition",
    "1 while the gateway sees this condition of the controller.",
    *DEVICE_LABELS,
    "condition",
)
DEVICE_METRICS = (UP, AGE, STATE, INFO, CONDITION)
"""The metrics of a device that come from no register."""


def device_labels(site: Site, device: Device) -> Labels:
    """The values of `DEVICE_LABELS`."""
    return (device.name, device.line.name, device.map.model, site.of_line(device.line.name), str(device.unit_id))


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
    elif point.kind is Kind.TEXT:
        labels = (*DEVICE_LABELS, point.name)
    return MetricInfo(point.metric, kind, point.help, labels)


class _Device:
    """A device and its labels."""

    __slots__ = ("_info", "_says", "closed", "device", "labels")

    def __init__(self, device: Device, labels: bytes) -> None:
        self.device = device
        self.labels = labels
        self.closed = labels + b"}"
        self._says: tuple[Identification | None, str | None] = (None, None)
        self._info: Tails = ()

    def info(self, snapshot: Snapshot) -> Tails:
        """What the device says of itself, nothing while it did not; hardly ever something else."""
        says, serial_number = snapshot.identification, snapshot.serial_number
        if (says, serial_number) != self._says:
            self._says = (says, serial_number)
            self._info = ()
            if says is not None:
                texts = (says.vendor, says.product, says.revision, serial_number or "")
                self._info = (b"", b",%b} 1.0\n" % label_pairs(INFO.labels[len(DEVICE_LABELS) :], texts))
        return self._info


@dataclass(frozen=True, slots=True)
class _Model:
    """The devices of one model by unit id, and how its points are written, by metric."""

    devices: tuple[_Device, ...]
    columns: Mapping[str, Column]

    def look(self) -> tuple[tuple[_Device, Snapshot], ...]:
        """The devices as they are now."""
        return tuple((each, each.device.snapshot) for each in self.devices)


def _shown(seen: Iterable[tuple[_Device, Snapshot]]) -> Shown:
    online = [
        (each.labels, each.closed, snapshot.shown(), snapshot.shown_texts())
        for each, snapshot in seen
        if snapshot.state is DeviceState.ONLINE
    ]
    return Shown(*zip(*online, strict=True)) if online else Shown((), (), (), ())


@dataclass(frozen=True, slots=True)
class Moment:
    """All devices of a site as they were at one moment; what is written of it is the same whenever it is written."""

    devices: tuple[tuple[_Device, Snapshot], ...]
    shown: tuple[tuple[_Model, Shown], ...]


class DeviceMetrics:
    """Every device of a site, from its snapshot; never asks a line."""

    def __init__(self, site: Site) -> None:
        """Prepare all families; MapError when two models give one metric name different labels or types."""
        self._families: dict[str, MetricInfo] = {info.name: info for info in DEVICE_METRICS}
        devices: dict[str, list[_Device]] = {}
        for device in site.devices:
            labels = label_pairs(DEVICE_LABELS, device_labels(site, device))
            devices.setdefault(device.map.model, []).append(_Device(device, labels))
        self._models = [_Model(tuple(each), self._columns(each[0].device.map)) for each in devices.values()]

    def _columns(self, model: DeviceMap) -> Mapping[str, Column]:
        columns: dict[str, Column] = {}
        for point in model.points:
            info = point_metric(point)
            if info is None:
                continue
            known = self._families.setdefault(info.name, info)
            if (known.kind, known.labels) != (info.kind, info.labels):
                raise MapError(f"{model.model}: point {point.name}: metric {info.name} has other labels elsewhere")
            columns[info.name] = column_of(model, point, info.name)
        return columns

    def look(self) -> Moment:
        """The devices as they are now."""
        seen = [(model, model.look()) for model in self._models]
        return Moment(
            tuple(each for _, devices in seen for each in devices),
            tuple((model, _shown(devices)) for model, devices in seen),
        )

    def families(self, moment: Moment, now: float) -> Iterator[tuple[MetricInfo, Lines]]:
        """Each family that has samples, with the lines of all devices, by model and unit id; `now` is for the ages.

        A large family comes in parts, one after the other.
        """
        if moment.devices:
            yield from _status(moment.devices, now)
        for name, info in self._families.items():
            for model, shown in moment.shown:
                if name in model.columns:
                    for pieces in model.columns[name].parts(shown):
                        if pieces:
                            yield info, pieces


def _status(seen: Sequence[tuple[_Device, Snapshot]], now: float) -> Iterator[tuple[MetricInfo, Lines]]:
    """The families of `DEVICE_METRICS`, of one device or more."""
    up = _begin(UP)
    yield UP, [up + each.closed + number(snapshot.state is DeviceState.ONLINE) for each, snapshot in seen]
    age = _begin(AGE)
    ages = [
        age + each.closed + number(max(0.0, now - snapshot.last_reply_at))
        for each, snapshot in seen
        if snapshot.last_reply_at is not None
    ]
    if ages:
        yield AGE, ages
    state = _begin(STATE)
    yield STATE, [(state + each.labels).join(_STATES[snapshot.state]) for each, snapshot in seen]
    info = _begin(INFO)
    infos = [(info + each.labels).join(each.info(snapshot)) for each, snapshot in seen]
    if any(infos):
        yield INFO, infos
    condition = _begin(CONDITION)
    yield CONDITION, [(condition + each.labels).join(_conditions(snapshot.warnings)) for each, snapshot in seen]


def _begin(info: MetricInfo) -> bytes:
    return f"{info.name}{{".encode()


_STATES: Mapping[DeviceState, Tails] = {
    state: states("state", {each.value: each is state for each in DeviceState}) for state in DeviceState
}


@lru_cache(maxsize=64)
def _conditions(warnings: frozenset[str]) -> Tails:
    return states("condition", dict.fromkeys(CONDITIONS, False) | dict.fromkeys(sorted(warnings), True))
