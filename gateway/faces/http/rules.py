"""How the gateway's own metrics are read from its counters: a metric and a way to its numbers, as data.

A source is what a scrape found of one line, device or face; a rule reads one metric of all sources of its kind.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Generic, TypeVar

from gateway.core.histogram import Histogram
from gateway.faces.http.metric import Labels, MetricInfo, counter, gauge, histogram
from gateway.faces.http.text import Lines, label_pairs, number, sample_lines

SOURCES_A_PART = 64
"""Sources that are read in one go."""

T = TypeVar("T")

Sample = tuple[Labels, float | Histogram]
"""Values of the labels beyond those of the source, and the number."""


@dataclass(frozen=True, slots=True)
class Source(Generic[T]):
    """Something that is read, with its labels and the same as written in a sample."""

    of: T
    labels: Labels = ()
    written: bytes = b""

    @classmethod
    def labelled(cls, of: T, names: Labels, values: Labels) -> Source[T]:
        """With these labels."""
        return cls(of, values, label_pairs(names, values))


@dataclass(frozen=True, slots=True)
class Rule(Generic[T]):
    """A metric and how it is read; the labels of its samples stand last in `metric.labels`."""

    metric: MetricInfo
    read: Callable[[T], Iterable[Sample]]

    def lines(self, sources: Sequence[Source[T]]) -> Lines:
        """The samples of all sources."""
        info = self.metric
        begin = info.name.encode()
        lines = []
        for source in sources:
            for extra, value in self.read(source.of):
                labels = source.written
                if extra:
                    more = _pairs(info.labels, extra)
                    labels = labels + b"," + more if labels else more
                if labels and not isinstance(value, Histogram):  # nearly always
                    lines.append(begin + b"{" + labels + b"}" + number(value))
                else:
                    lines.append(sample_lines(info, labels, value))
        return lines


@lru_cache(maxsize=1024)
def _pairs(names: Labels, extra: Labels) -> bytes:
    """The labels of a rule, which are the last of `names`; the same for all sources, so few are worth keeping."""
    return label_pairs(names[-len(extra) :], extra)


def one(metric: MetricInfo, pick: Callable[[T], float]) -> Rule[T]:
    """One number a source."""
    return Rule(metric, lambda source: (((), pick(source)),))


def known(metric: MetricInfo, pick: Callable[[T], float | None]) -> Rule[T]:
    """One number a source, absent while it is None."""

    def read(source: T) -> Iterable[Sample]:
        value = pick(source)
        return () if value is None else (((), value),)

    return Rule(metric, read)


def each(metric: MetricInfo, pick: Callable[[T], Mapping[str, float]]) -> Rule[T]:
    """One number for each key of a mapping, the key as the last label."""

    def read(source: T) -> Iterable[Sample]:
        counts = pick(source)
        return [((key,), counts[key]) for key in sorted(counts)]

    return Rule(metric, read)


def times(metric: MetricInfo, pick: Callable[[T], Histogram]) -> Rule[T]:
    """One histogram a source."""
    return Rule(metric, lambda source: (((), pick(source)),))


def families(rules: Iterable[Rule[T]], sources: Sequence[Source[T]]) -> Iterator[tuple[MetricInfo, Lines]]:
    """Each metric that has samples, with its lines; those of many sources in parts, one after the other."""
    for rule in rules:
        for at in range(0, len(sources), SOURCES_A_PART):
            lines = rule.lines(sources[at : at + SOURCES_A_PART])
            if lines:
                yield rule.metric, lines


def gateway_gauge(name: str, help_text: str, *labels: str) -> MetricInfo:
    """Describe a gauge of the gateway itself."""
    return gauge(f"prostar_gateway_{name}", help_text, *labels)


def gateway_counter(name: str, help_text: str, *labels: str) -> MetricInfo:
    """Describe a counter of the gateway itself; `name` without `_total`."""
    return counter(f"prostar_gateway_{name}_total", help_text, *labels)


def gateway_histogram(name: str, help_text: str, *labels: str) -> MetricInfo:
    """Describe a histogram of the gateway itself."""
    return histogram(f"prostar_gateway_{name}", help_text, *labels)
