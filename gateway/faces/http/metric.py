"""What is said about a metric, once, before it has a value.

The descriptions are data, so that the metric list in the documentation is made from the same lines as
the reply to a scrape. A name is written as it is scraped: counters end in `_total`.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily
from prometheus_client.metrics_core import Metric

Sample = tuple[tuple[str, ...], float]
"""Label values, in the order of the metric's label names, and the number."""


class MetricKind(StrEnum):
    """The Prometheus type of a metric."""

    GAUGE = "gauge"
    COUNTER = "counter"


@dataclass(frozen=True, slots=True)
class MetricInfo:
    """A metric's name, type, help text and label names."""

    name: str
    kind: MetricKind
    help: str
    labels: tuple[str, ...] = ()

    def family(self, samples: Iterable[Sample]) -> Metric:
        """The metric with its samples, as prometheus-client writes it out."""
        family: CounterMetricFamily | GaugeMetricFamily
        if self.kind is MetricKind.COUNTER:
            family = CounterMetricFamily(self.name, self.help, labels=self.labels)
        else:
            family = GaugeMetricFamily(self.name, self.help, labels=self.labels)
        for labels, value in samples:
            family.add_metric(labels, value)
        return family


def gauge(name: str, help_text: str, *labels: str) -> MetricInfo:
    """Describe a gauge."""
    return MetricInfo(name, MetricKind.GAUGE, help_text, labels)


def counter(name: str, help_text: str, *labels: str) -> MetricInfo:
    """Describe a counter; `name` ends in `_total`."""
    return MetricInfo(name, MetricKind.COUNTER, help_text, labels)
