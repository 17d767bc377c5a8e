"""Stored days as OpenMetrics text, for `promtool tsdb create-blocks-from openmetrics`.

Rule 1: a field is `morningstar_<field>_daily_<base unit>`, a gauge with the labels of the controllers' other metrics
        and `controller`, whose history it is; one sample a day, at the time when the day was written (an estimate:
        `morningstar_daily_time_error_seconds` says how good). Days without a date are left out.
Rule 2: a bit field has a series for each bit that was ever set on the days selected, 1 or 0 for each day.
Rule 3: as the format wants it, all samples of a metric stand together, and of a series in order of time. So the
        history is read once a metric, and never held in memory.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from itertools import groupby
from operator import attrgetter

from gateway.core.daylog import Selection
from gateway.devices.log import HOURMETER
from gateway.devices.model import LogField, Value
from gateway.devices.schema import load_map, models
from gateway.devices.units import METRIC_PREFIX, UNITS
from gateway.history.columns import bit_names, columns
from gateway.history.reader import HistoryReader, Owner, StoredDay

TIME_ERROR = f"{METRIC_PREFIX}daily_time_error_seconds"
LABELS = ("device", "line", "model", "site", "unit_id", "controller")
"""Of every sample, in this order; bit fields have `bit` after them."""


@dataclass(frozen=True, slots=True)
class DailyMetric:
    """A metric of the daily log; `field` is None for the error of the time."""

    name: str
    unit: str
    help: str
    field: LogField | None


def daily_metrics(of_models: tuple[str, ...] | None = None) -> tuple[DailyMetric, ...]:
    """The metrics of these models' logs (all that have a map), each once."""
    text = "By how much the time of that day's samples may be wrong, either way."
    found = {TIME_ERROR: DailyMetric(TIME_ERROR, "seconds", text, None)}
    for model in models() if of_models is None else of_models:
        layout = load_map(model).log if model in models() else None
        for field in () if layout is None else layout.fields:
            unit = UNITS[field.unit].metric_suffix
            name = f"{METRIC_PREFIX}{field.name}_daily" + (f"_{unit}" if unit else "")
            found.setdefault(name, DailyMetric(name, unit, field.help, field))
    return tuple(found.values())


def passes(reader: HistoryReader, selection: Selection) -> int:
    """How often `openmetrics` reads the days."""
    return len(daily_metrics(reader.models(selection))) + 1


def openmetrics(
    reader: HistoryReader, selection: Selection, site: str, progress: Callable[[int], None]
) -> Iterator[str]:
    """The text, line by line; `progress` is told how many days were read."""
    return _Writer(reader, selection, site, progress).lines()


@dataclass(frozen=True, slots=True)
class _Writer:
    reader: HistoryReader
    selection: Selection
    site: str
    progress: Callable[[int], None]

    def lines(self) -> Iterator[str]:
        ever = self._ever_set()
        for metric in daily_metrics(self.reader.models(self.selection)):
            yield f"# TYPE {metric.name} gauge\n"
            if metric.unit:
                yield f"# UNIT {metric.name} {metric.unit}\n"
            yield f"# HELP {metric.name} {_escaped(metric.help)}\n"
            if metric.field is not None and metric.field.bits is not None:
                yield from self._bit_samples(metric.name, metric.field.name, ever)
            else:
                yield from self._samples(metric)
        yield "# EOF\n"

    def _dated(self) -> Iterator[StoredDay]:
        for day in self.reader.days(self.selection):
            self.progress(1)
            if day.written_at is not None:
                yield day

    def _samples(self, metric: DailyMetric) -> Iterator[str]:
        owner, labels = None, ""
        for day in self._dated():
            value = _number(day, metric.field)
            if value is None:
                continue
            if owner != day.owner:
                owner, labels = day.owner, _labels(day.owner, self.site)
            yield f"{metric.name}{{{labels}}} {value!r} {day.written_at!r}\n"

    def _ever_set(self) -> dict[tuple[Owner, str], int]:
        """By controller and field, the bits that were ever set."""
        ever: dict[tuple[Owner, str], int] = {}
        fields = {
            model: [c.field.name for c in columns(model) if c.bits] for model in self.reader.models(self.selection)
        }
        for day in self._dated():
            for name in fields[day.owner.model]:
                if value := day.values.get(name):
                    ever[day.owner, name] = ever.get((day.owner, name), 0) | int(value)
        return ever

    def _bit_samples(self, name: str, field: str, ever: Mapping[tuple[Owner, str], int]) -> Iterator[str]:
        """Series by series, as rule 3 wants it; so the days of one controller at a time are held."""
        for owner, days in groupby(self._dated(), key=attrgetter("owner")):
            set_once = ever.get((owner, field), 0)
            if not set_once:
                continue
            names = next(column.bits for column in columns(owner.model) if column.field.name == field) or {}
            held = [(int(day.values[field]), day.written_at) for day in days if field in day.values]
            labels = _labels(owner, self.site)
            for number in range(set_once.bit_length()):
                if set_once >> number & 1:
                    (bit,) = bit_names(1 << number, names)
                    for value, at in held:
                        yield f'{name}{{{labels},bit="{_escaped(bit)}"}} {value >> number & 1} {at!r}\n'


def _number(day: StoredDay, field: LogField | None) -> Value | None:
    if field is None:
        return day.error_s
    if field.name == HOURMETER:
        return day.hourmeter * UNITS[field.unit].metric_scale
    value = day.values.get(field.name)
    return None if value is None else value * UNITS[field.unit].metric_scale


def _labels(owner: Owner, site: str) -> str:
    values = (owner.device, owner.line, owner.model, owner.site or site, str(owner.unit_id), owner.identity)
    return ",".join(f'{name}="{_escaped(value)}"' for name, value in zip(LABELS, values, strict=True))


def _escaped(text: str) -> str:
    return text.replace("\\", "\\\\").replace("\n", "\\n").replace('"', '\\"')
