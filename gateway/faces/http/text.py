"""The two text formats of a scrape, written as bytes.

Prometheus text 0.0.4 and OpenMetrics 1.0 differ in what stands above the samples and in the last line; the samples
themselves are the same bytes in both. So a sample is written once and kept for whoever asks next.

Rule 1: label values are escaped as both formats demand: backslash, double quote and line feed.
Rule 2: a family's samples stand together below its header; a family without samples has no header.
Rule 3: OpenMetrics is given to who prefers it, text 0.0.4 to everybody else, whatever is asked.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

from gateway.core.histogram import Histogram
from gateway.faces.http.metric import MetricInfo, MetricKind

Lines = Sequence[bytes]
"""Sample lines in pieces, each of whole lines."""

_OPENMETRICS_VERSIONS = ("", "0.0.1", "1.0.0")
_NUMBERS_KEPT = 8192
_TEXT_VERSIONS = ("", "0.0.4")
_WEIGHT = re.compile(r"(?:0(?:\.\d{0,3})?|1(?:\.0{0,3})?)")


@dataclass(frozen=True, slots=True)
class Format:
    """One of the two formats."""

    content_type: str
    openmetrics: bool

    @property
    def end(self) -> bytes:
        """What closes the exposition."""
        return b"# EOF\n" if self.openmetrics else b""


TEXT = Format("text/plain; version=0.0.4; charset=utf-8", openmetrics=False)
OPENMETRICS = Format("application/openmetrics-text; version=1.0.0; charset=utf-8", openmetrics=True)


def negotiate(accept: str) -> Format:
    """The format for an Accept header (RFC 9110 §12.5.1); never fails."""
    openmetrics = text = 0.0
    for media_type, parameters, weight in _accepted(accept):
        version = parameters.get("version", "")
        if media_type == "application/openmetrics-text" and version in _OPENMETRICS_VERSIONS:
            openmetrics = max(openmetrics, weight)
        elif media_type == "text/plain" and version in _TEXT_VERSIONS:
            text = max(text, weight)
    return OPENMETRICS if openmetrics > 0.0 and openmetrics >= text else TEXT


def accepts_gzip(accept_encoding: str) -> bool:
    """Whether an Accept-Encoding header allows gzip (RFC 9110 §12.5.3)."""
    star = False
    for coding, _, weight in _accepted(accept_encoding):
        if coding in {"gzip", "x-gzip"}:
            return weight > 0.0
        star = star or (coding == "*" and weight > 0.0)
    return star


def _accepted(header: str) -> Iterator[tuple[str, dict[str, str], float]]:
    """The items of an Accept header: name, parameters, weight (1 where it is none)."""
    for item in header.split(","):
        name, *rest = (part.strip() for part in item.split(";"))
        parameters: dict[str, str] = {}
        for part in rest:
            key, _, value = part.partition("=")
            parameters[key.strip().lower()] = value.strip().strip('"')
        weight = parameters.pop("q", "")
        yield name.lower(), parameters, float(weight) if _WEIGHT.fullmatch(weight) else 1.0


def header(info: MetricInfo, form: Format) -> bytes:
    """The lines above a family's samples."""
    text = info.help.replace("\\", r"\\").replace("\n", r"\n")
    if not form.openmetrics:
        return f"# HELP {info.name} {text}\n# TYPE {info.name} {info.kind}\n".encode()
    text = text.replace('"', r"\"")
    unit = f"# UNIT {info.family} {info.unit}\n" if info.unit else ""
    return f"# HELP {info.family} {text}\n# TYPE {info.family} {info.kind}\n{unit}".encode()


class _Numbers(dict[float, bytes]):
    """Number → how it is written; forgets all when it is full."""

    def __missing__(self, value: float) -> bytes:
        if len(self) >= _NUMBERS_KEPT:
            self.clear()
        text = repr(value + 0.0)  # a float, and no negative zero
        if text[-1] in "fn":  # inf and nan, which the formats spell in their own way
            text = {"inf": "+Inf", "-inf": "-Inf"}.get(text, "NaN")
        self[value] = line = f" {text}\n".encode()
        return line


number = _Numbers().__getitem__
"""A sample's number and the end of its line, so that reading it back gives the same float.

Measured values come from half-precision floats and so repeat a lot: most of them are only looked up.
"""


def escaped(value: str) -> str:
    """A label value between its quotes."""
    return value.replace("\\", r"\\").replace('"', r"\"").replace("\n", r"\n")


def label_pairs(names: Iterable[str], values: Iterable[str]) -> bytes:
    """Labels without the braces, `a="x",b="y"`."""
    pairs = zip(names, values, strict=True)
    return ",".join(f'{name}="{escaped(value)}"' for name, value in pairs).encode()


def sample_lines(info: MetricInfo, labels: bytes, value: float | Histogram) -> bytes:
    """The line of a number, or the lines of a histogram; `labels` as from `label_pairs`."""
    name = info.name.encode()
    braces = b"{" + labels + b"}" if labels else b""
    if not isinstance(value, Histogram):
        return name + braces + number(value)
    assert info.kind is MetricKind.HISTOGRAM
    begin = name + b"_bucket{" + labels + (b',le="' if labels else b'le="')
    buckets = [begin + number(bound).strip() + b'"}' + number(count) for bound, count in value.cumulative()]
    total = name + b"_sum" + braces + number(value.sum_s) + name + b"_count" + braces + number(value.count)
    return b"".join(buckets) + total
