"""What is said about a metric, once, before it has a value.

The descriptions are data, so that the metric list in the documentation is made from the same lines as
the reply to a scrape. A name is written as it is scraped: counters end in `_total`.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from gateway.devices.units import UNITS

Labels = tuple[str, ...]
"""Label values, in the order of the metric's label names."""

BASE_UNITS = tuple(
    sorted({unit.metric_suffix for unit in UNITS.values() if unit.metric_suffix} | {"bytes"}, key=len, reverse=True)
)
"""Units by which a metric's name may end, the longest first."""


class MetricKind(StrEnum):
    """The Prometheus type of a metric."""

    GAUGE = "gauge"
    COUNTER = "counter"
    HISTOGRAM = "histogram"


@dataclass(frozen=True, slots=True)
class MetricInfo:
    """A metric's name, type, help text and label names."""

    name: str
    kind: MetricKind
    help: str
    labels: tuple[str, ...] = ()

    @property
    def family(self) -> str:
        """The name of the metric family in OpenMetrics: without a counter's `_total`."""
        return self.name.removesuffix("_total") if self.kind is MetricKind.COUNTER else self.name

    @property
    def unit(self) -> str:
        """The base unit that the family's name ends by; "" for a number without one."""
        return next((unit for unit in BASE_UNITS if self.family.endswith(f"_{unit}")), "")


def gauge(name: str, help_text: str, *labels: str) -> MetricInfo:
    """Describe a gauge."""
    return MetricInfo(name, MetricKind.GAUGE, help_text, labels)


def counter(name: str, help_text: str, *labels: str) -> MetricInfo:
    """Describe a counter; `name` ends in `_total`."""
    return MetricInfo(name, MetricKind.COUNTER, help_text, labels)


def histogram(name: str, help_text: str, *labels: str) -> MetricInfo:
    """Describe a histogram; `name` ends in its unit."""
    return MetricInfo(name, MetricKind.HISTOGRAM, help_text, labels)
