"""The controllers' values as metrics, by the names that the maps give.

Rules: a value is shown only while its device is online; the series of any other device are absent, so
that no line in a graph goes on flat. What says so (`morningstar_up`, the state, the age) is always there.

An enumeration is one series a state with the label `state`, 1 for the one that holds, else 0. A bit field is
one series a named bit with the label `bit`. A number or a set bit that the map does not name has a series
while it lasts (`value_17`, `bit_9`), so that it cannot pass unseen. A text is one series of 1, with the text in a label
that is called as the point is.

A scrape costs what has changed: a device's lines are kept, and when its snapshot was replaced only those of
points whose value is another one are written anew. All lines of a device in one scrape are of one snapshot.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

from gateway.core.site import Device, Site
from gateway.core.snapshot import IDENTITY_MISMATCH, NOT_REWRITTEN, UNKNOWN_MODEL, DeviceState, Snapshot
from gateway.devices.model import DeviceMap, Kind, Point, Value
from gateway.errors import MapError
from gateway.faces.http.metric import Labels, MetricInfo, MetricKind, gauge
from gateway.faces.http.text import Lines, escaped, label_pairs, number, sample_lines

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


class _Writer(Protocol):
    """How a point that is more than one series becomes lines."""

    def lines(self, labels: bytes, value: Value | str) -> bytes:
        """The lines of the point's present value; `labels` are the device's."""
        ...


class _OneOf:
    def __init__(self, metric: str, names: Mapping[int, str]) -> None:
        self._begin = f"{metric}{{".encode()
        self._names = {code: escaped(name).encode() for code, name in names.items()}

    def lines(self, labels: bytes, value: Value | str) -> bytes:
        begin = b'%b%b,state="' % (self._begin, labels)
        out = [b'%b%b"} %d.0\n' % (begin, name, code == value) for code, name in self._names.items()]
        if value not in self._names:
            out.append(b'%bvalue_%d"} 1.0\n' % (begin, int(value)))
        return b"".join(out)


class _Bits:
    def __init__(self, metric: str, names: Mapping[int, str]) -> None:
        self._begin = f"{metric}{{".encode()
        self._names = {bit: escaped(name).encode() for bit, name in names.items()}

    def lines(self, labels: bytes, value: Value | str) -> bytes:
        bits = int(value)
        begin = b'%b%b,bit="' % (self._begin, labels)
        named = [b'%b%b"} %d.0\n' % (begin, name, bits >> bit & 1) for bit, name in self._names.items()]
        unnamed = [
            b'%bbit_%d"} 1.0\n' % (begin, bit)
            for bit in range(bits.bit_length())
            if bits >> bit & 1 and bit not in self._names
        ]
        return b"".join(named + unnamed)


class _Text:
    def __init__(self, metric: str, label: str) -> None:
        self._begin = f"{metric}{{".encode()
        self._label = label.encode()

    def lines(self, labels: bytes, value: Value | str) -> bytes:
        return b'%b%b,%b="%b"} 1.0\n' % (self._begin, labels, self._label, escaped(str(value)).encode())


def _writer(model: DeviceMap, point: Point, metric: str) -> _Writer | None:
    if point.enumeration is not None:
        return _OneOf(metric, {entry.number: entry.name for entry in model.enumerations[point.enumeration]})
    if point.bits is not None:
        return _Bits(metric, {bit.number: bit.name for bit in model.bit_tables[point.bits]})
    if point.kind is Kind.TEXT:
        return _Text(metric, point.name)
    return None


@dataclass(frozen=True, slots=True)
class _Plan:
    """How the points of one model are written: columns with one entry a point, first `points`, then `texts`."""

    points: tuple[str, ...]
    texts: tuple[str, ...]
    families: tuple[int, ...]
    begins: tuple[bytes, ...]  # how a plain number's line begins
    scales: tuple[float, ...]  # what a plain number is multiplied by
    writers: tuple[_Writer | None, ...]  # None: it is a plain number


class _DeviceLines:
    """The lines of one device, kept from scrape to scrape."""

    def __init__(self, device: Device, labels: bytes, plan: _Plan, families: int) -> None:
        self.device = device
        self.labels = labels
        self._plan = plan
        self._begins = tuple(begin + labels + b"}" for begin in plan.begins)
        self._values: list[Value | str | None] = [None] * (len(plan.points) + len(plan.texts))
        self._lines: Lines = (b"",) * families
        self._written: Snapshot | None = None

    def of_now(self) -> Lines:
        """The lines of the present snapshot; never changed afterwards."""
        snapshot = self.device.snapshot
        if snapshot is self._written:
            return self._lines
        lines = list(self._lines)
        before = self._written
        if before is None or _status(before) != _status(snapshot):
            lines[: len(DEVICE_METRICS)] = _status_lines(self.labels, snapshot)
        plan = self._plan
        values: list[Value | str | None] = list(map(snapshot.shown().get, plan.points))
        if plan.texts:
            values += map(snapshot.shown_texts().get, plan.texts)
        columns = (values, self._values, plan.families, self._begins, plan.scales, plan.writers)
        # The one loop that runs for every value of every device: tens of thousands of times a scrape.
        for value, old, family, begin, scale, writer in zip(*columns, strict=True):
            if value != old:
                if value is None:
                    lines[family] = b""
                elif writer is not None:
                    lines[family] = writer.lines(self.labels, value)
                elif not isinstance(value, str):
                    lines[family] = begin + number(value * scale)
        self._values = values
        self._written = snapshot
        self._lines = lines
        return lines


def _status(snapshot: Snapshot) -> tuple[object, ...]:
    return (snapshot.state, snapshot.identification, snapshot.serial_number, snapshot.warnings)


def _status_lines(labels: bytes, snapshot: Snapshot) -> list[bytes]:
    """The lines of `DEVICE_METRICS`; the age is not among them, for it changes without a snapshot."""
    state = snapshot.state
    states = (
        sample_lines(STATE, b'%b,state="%b"' % (labels, each.value.encode()), each is state) for each in DeviceState
    )
    says = snapshot.identification
    info = b""
    if says is not None:
        texts = (says.vendor, says.product, says.revision, snapshot.serial_number or "")
        info = sample_lines(INFO, labels + b"," + label_pairs(INFO.labels[len(DEVICE_LABELS) :], texts), 1)
    conditions = (
        sample_lines(CONDITION, labels + b"," + label_pairs(("condition",), (each,)), each in snapshot.warnings)
        for each in dict.fromkeys((*CONDITIONS, *sorted(snapshot.warnings)))
    )
    up = sample_lines(UP, labels, state is DeviceState.ONLINE)
    return [up, b"", b"".join(states), info, b"".join(conditions)]


class DeviceMetrics:
    """Every device of a site, from its snapshot; never asks a line."""

    def __init__(self, site: Site) -> None:
        """Prepare all families; MapError when two models give one metric name different labels or types."""
        self._families: dict[str, MetricInfo] = {info.name: info for info in DEVICE_METRICS}
        plans = {
            model.model: self._plan(model)
            for model in {device.map.model: device.map for device in site.devices}.values()
        }
        self._devices = [
            _DeviceLines(
                device,
                label_pairs(DEVICE_LABELS, device_labels(site, device)),
                plans[device.map.model],
                len(self._families),
            )
            for device in site.devices
        ]

    def _plan(self, model: DeviceMap) -> _Plan:
        columns: list[tuple[str, int, bytes, float, _Writer | None]] = []
        for point in sorted(model.points, key=lambda point: point.kind is Kind.TEXT):
            info = point_metric(point)
            if info is None:
                continue
            known = self._families.setdefault(info.name, info)
            if (known.kind, known.labels) != (info.kind, info.labels):
                raise MapError(f"{model.model}: point {point.name}: metric {info.name} has other labels elsewhere")
            family = list(self._families).index(info.name)
            begin = f"{info.name}{{".encode()
            columns.append((point.name, family, begin, point.metric_scale, _writer(model, point, info.name)))
        if not columns:
            return _Plan((), (), (), (), (), ())
        points, families, begins, scales, writers = zip(*columns, strict=True)
        texts = tuple(name for name, *_, writer in columns if isinstance(writer, _Text))
        return _Plan(points[: len(points) - len(texts)], texts, families, begins, scales, writers)

    def write(self) -> Iterator[Lines]:
        """Each device's lines, written as far as they changed; a step of the iteration is one device."""
        for lines in self._devices:
            yield lines.of_now()

    def families(self, written: Sequence[Lines], now: float) -> Iterator[tuple[MetricInfo, Lines]]:
        """Each family that has samples with the lines of all devices; `written` is what `write` gave."""
        ages = self._ages(now)
        for info, *lines in zip(self._families.values(), *written, strict=True):
            present = ages if info is AGE else lines
            if any(present):
                yield info, present

    def _ages(self, now: float) -> Lines:
        return [
            sample_lines(AGE, each.labels, max(0.0, now - at))
            for each in self._devices
            if (at := each.device.snapshot.last_reply_at) is not None
        ]
