"""The metric list: every metric of the controllers, from their maps, and every one of the gateway's own."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from gateway.devices.agreement import all_maps
from gateway.devices.model import DeviceMap, Point
from gateway.devices.units import UNITS
from gateway.faces.http.devices import DEVICE_LABELS, DEVICE_METRICS, point_metric
from gateway.faces.http.metric import MetricInfo
from gateway.faces.http.own import OWN_METRICS
from gateway.generate.markdown import code, generated_mark, page, table

_INTRO = """\
All of them are served at `/metrics`, from memory: a scrape never waits for a serial line. A value of a controller is
there only while the controller is online; the series of a silent one vanish, `morningstar_up` says 0, and
`morningstar_last_reply_age_seconds` grows. A sensor that is not fitted has no series."""

_NAMES = """\
- A controller's metric is `morningstar_<point>_<base unit>`; a point has one name on all models.
- Base units are volts, amperes, watts, degrees Celsius, ohms, seconds and ratios: hours, days and minutes of the
  registers become seconds.
- Energy is in watt-hours and charge in ampere-hours, not in joules and coulombs: this trade's meters, data sheets and
  tariffs speak only of them. They are written as one word, because `ampere_hours` would read as a time in hours (and
  `promtool check metrics` says so).
- A total that only grows until somebody clears it by command is a counter and ends in `_total`; `rate()` and
  `increase()` see the clearing as a counter reset. What is cleared in daily use (resettable counters, today's values)
  is a gauge without `_total`.
- An enumeration is one series a state with the label `state`, a bit field one series a bit with the label `bit`; each
  is 1 or 0. A number or bit that the document does not name shows itself as `value_<n>` or `bit_<n>`.
- A text is a series of 1 that ends in `_info`, with the text in a label that is called as the point is.
- Voltage settings of a ProStar are those of a 12 V battery, as the controller keeps them;
  `morningstar_settings_voltage_multiplier_ratio` is what it multiplies them by."""

_HEADINGS = ("Metric", "Type", "Labels", "What")


def metric_outputs() -> dict[str, str]:
    """The page by path from the repository."""
    maps = all_maps()
    return {"docs/metrics.md": metric_page(maps, OWN_METRICS)}


def metric_page(maps: Iterable[DeviceMap], own: Iterable[MetricInfo]) -> str:
    """The page for these models and these metrics of the gateway itself."""
    return page(_blocks(tuple(maps), tuple(own)))


def _blocks(maps: tuple[DeviceMap, ...], own: tuple[MetricInfo, ...]) -> Iterator[str]:
    yield generated_mark("gateway/devices/maps and gateway/faces/http")
    yield "# Metrics"
    yield _INTRO
    yield "## Names"
    yield _NAMES
    yield "## Controllers"
    yield f"Each has the labels {_codes(DEVICE_LABELS)}; *Labels* names those beyond."
    yield table(_HEADINGS, (_info_row(info, DEVICE_LABELS) for info in DEVICE_METRICS))
    yield "### From registers"
    yield table(("Metric", "Type", "Unit", "Labels", "Models", "What"), _point_rows(maps))
    yield "### Values of the labels"
    yield from _label_values(maps)
    yield "## The gateway itself"
    yield (
        "Counters begin at 0 when the gateway starts. `process_*` and `python_gc_*` come beside them, named "
        "as all Python exporters name them."
    )
    yield table(_HEADINGS, (_info_row(info, ()) for info in own))


def _codes(names: Iterable[str]) -> str:
    return ", ".join(code(name) for name in names)


def _info_row(info: MetricInfo, common: tuple[str, ...]) -> tuple[str, ...]:
    labels = [name for name in info.labels if name not in common]
    return (code(info.name), info.kind.value, _codes(labels), info.help)


def _point_rows(maps: tuple[DeviceMap, ...]) -> Iterator[tuple[str, ...]]:
    points: dict[str, tuple[Point, list[str]]] = {}
    for device_map in maps:
        for point in device_map.points:
            if point.metric is not None:
                points.setdefault(point.metric, (point, []))[1].append(device_map.model)
    for name in sorted(points):
        point, of_models = points[name]
        info = point_metric(point)
        assert info is not None
        _, kind, labels, text = _info_row(info, DEVICE_LABELS)
        unit = UNITS[point.unit].metric_suffix.replace("_", " ")
        yield code(name), kind, unit, labels, ", ".join(of_models), text


def _label_values(maps: tuple[DeviceMap, ...]) -> Iterator[str]:
    rows: dict[tuple[str, str], dict[str, None]] = {}  # a set that keeps the order
    for device_map in maps:
        for point in device_map.points:
            if point.metric is None:
                continue
            if point.enumeration is not None:
                names = [value.name for value in device_map.enumerations[point.enumeration]]
                rows.setdefault((point.metric, "state"), {}).update(dict.fromkeys(names))
            elif point.bits is not None:
                names = [bit.name for bit in device_map.bit_tables[point.bits]]
                rows.setdefault((point.metric, "bit"), {}).update(dict.fromkeys(names))
    yield table(
        ("Metric", "Label", "Values"),
        ((code(metric), code(name), _codes(values)) for (metric, name), values in sorted(rows.items())),
    )
