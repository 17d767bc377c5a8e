"""What the demo shows, taken from a scrape of the gateway's own /metrics.

The demo sees what Prometheus sees: a value that the gateway withholds is a dash here. Metric names come from the
maps, so that this file knows points, not spellings.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from prometheus_client.parser import text_string_to_metric_families
from prometheus_client.samples import Sample

from gateway.devices.agreement import all_maps

NUMBERS = (
    "battery_voltage",
    "battery_current_net",
    "charge_current",
    "array_voltage",
    "charge_power",
    "load_voltage",
    "load_current",
)
STATES = ("charge_state", "load_state")
RATE_WINDOW_S = 10.0

_AGE = "morningstar_last_reply_age_seconds"
_QUALITY = "morningstar_device_state"
_LINE_UP = "prostar_gateway_line_up"
_LINE_USE = "prostar_gateway_line_use_ratio"
_LINE_REQUESTS = "prostar_gateway_line_requests_total"
_LINE_ERRORS = "prostar_gateway_line_errors_total"


@dataclass(frozen=True, slots=True)
class DeviceView:
    """One row of the device table; None: no value now."""

    unit_id: int
    name: str
    line: str
    numbers: Mapping[str, float]  # of NUMBERS, those that have a value
    states: Mapping[str, str]  # of STATES, likewise
    age_s: float | None
    quality: str


@dataclass(frozen=True, slots=True)
class LineView:
    """One row of the line table."""

    name: str
    up: bool
    use_ratio: float
    requests: float
    errors: float  # a controller's own exception is a reply, and not among them


@dataclass(frozen=True, slots=True)
class View:
    """One scrape."""

    devices: tuple[DeviceView, ...]  # ascending unit id
    lines: tuple[LineView, ...]  # in the order of the scrape


def read_view(scrape: str) -> View:
    """The view of a scrape in the text format."""
    samples: dict[str, list[Sample]] = {}
    for family in text_string_to_metric_families(scrape):
        for sample in family.samples:
            samples.setdefault(sample.name, []).append(sample)
    points = {point.name: point for device_map in all_maps() for point in device_map.points}
    metrics = {name: points[name].metric or "" for name in (*NUMBERS, *STATES)}
    devices = [
        DeviceView(
            unit_id=int(unit),
            name=name,
            line=line,
            numbers=_values(samples, metrics, NUMBERS, unit),
            states=_held(samples, metrics, STATES, unit),
            age_s=_first(samples.get(_AGE, ()), "unit_id", unit),
            quality=_held(samples, {"quality": _QUALITY}, ("quality",), unit).get("quality", "unknown"),
        )
        for unit, name, line in dict.fromkeys(
            (sample.labels["unit_id"], sample.labels["device"], sample.labels["line"])
            for sample in samples.get(_QUALITY, ())
        )
    ]
    lines = [
        LineView(
            name=sample.labels["line"],
            up=sample.value == 1,
            use_ratio=_first(samples.get(_LINE_USE, ()), "line", sample.labels["line"]) or 0.0,
            requests=_first(samples.get(_LINE_REQUESTS, ()), "line", sample.labels["line"]) or 0.0,
            errors=sum(
                error.value
                for error in samples.get(_LINE_ERRORS, ())
                if error.labels["line"] == sample.labels["line"] and error.labels["kind"] != "exception"
            ),
        )
        for sample in samples.get(_LINE_UP, ())
    ]
    return View(tuple(sorted(devices, key=lambda device: device.unit_id)), tuple(lines))


class Rates:
    """Requests a second of each line over the last ten seconds."""

    def __init__(self) -> None:
        self._seen: deque[tuple[float, Mapping[str, float]]] = deque()

    def add(self, view: View, now: float) -> Mapping[str, float]:
        """Take one view; the rates by line name, empty with the first view."""
        counts = {line.name: line.requests for line in view.lines}
        self._seen.append((now, counts))
        while len(self._seen) > 2 and now - self._seen[1][0] >= RATE_WINDOW_S:
            self._seen.popleft()
        began, before = self._seen[0]
        if now <= began:
            return {}
        return {name: (count - before.get(name, 0.0)) / (now - began) for name, count in counts.items()}


def _values(
    samples: Mapping[str, list[Sample]], metrics: Mapping[str, str], points: Iterable[str], unit: str
) -> dict[str, float]:
    found = {point: _first(samples.get(metrics[point], ()), "unit_id", unit) for point in points}
    return {point: value for point, value in found.items() if value is not None}


def _held(
    samples: Mapping[str, list[Sample]], metrics: Mapping[str, str], points: Iterable[str], unit: str
) -> dict[str, str]:
    """The state that holds (its series is 1) of each point that has one."""
    return {
        point: sample.labels["state"]
        for point in points
        for sample in samples.get(metrics[point], ())
        if sample.labels["unit_id"] == unit and sample.value == 1
    }


def _first(samples: Iterable[Sample], label: str, value: str) -> float | None:
    return next((sample.value for sample in samples if sample.labels[label] == value), None)
