"""Which format a client gets, and how samples are written."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.core.histogram import Histogram
from gateway.faces.http.metric import counter, gauge, histogram
from gateway.faces.http.text import (
    OPENMETRICS,
    TEXT,
    Format,
    accepts_gzip,
    header,
    label_pairs,
    negotiate,
    number,
    sample_lines,
)

PROMETHEUS_2 = (
    "application/openmetrics-text;version=1.0.0,application/openmetrics-text;version=0.0.1;q=0.75,"
    "text/plain;version=0.0.4;q=0.5,*/*;q=0.1"
)
PROMETHEUS_3 = (
    "application/openmetrics-text;version=1.0.0;escaping=allow-utf-8;q=0.6,"
    "application/openmetrics-text;version=0.0.1;q=0.5,text/plain;version=1.0.0;escaping=allow-utf-8;q=0.4,"
    "text/plain;version=0.0.4;q=0.3,*/*;q=0.2"
)


@pytest.mark.parametrize(
    ("accept", "form"),
    [
        ("", TEXT),
        ("*/*", TEXT),
        ("text/plain", TEXT),
        ("text/html,application/xhtml+xml,*/*;q=0.8", TEXT),
        (PROMETHEUS_2, OPENMETRICS),
        (PROMETHEUS_3, OPENMETRICS),
        ("application/openmetrics-text", OPENMETRICS),
        ('Application/OpenMetrics-Text ; version="1.0.0" ; charset=utf-8', OPENMETRICS),
        ("application/openmetrics-text;q=0.3, text/plain;q=0.5", TEXT),
        ("application/openmetrics-text;q=0", TEXT),
        ("application/openmetrics-text;version=2.0.0", TEXT),
        ("application/openmetrics-text;version=2.0.0,application/openmetrics-text;q=0.2", OPENMETRICS),
        ("application/openmetrics-text;q=nonsense", OPENMETRICS),
    ],
)
def test_negotiation(accept: str, form: Format) -> None:
    assert negotiate(accept) is form


@pytest.mark.parametrize(
    ("header_text", "allowed"),
    [
        ("", False),
        ("gzip", True),
        ("deflate, GZIP;q=0.5", True),
        ("gzip;q=0", False),
        ("gzip; q=0.000", False),
        ("br, *", True),
        ("*;q=0", False),
        ("gzip;q=0, *", False),
        ("identity", False),
    ],
)
def test_accept_encoding(header_text: str, allowed: bool) -> None:
    assert accepts_gzip(header_text) is allowed


@given(st.text() | st.from_regex(r"(application/openmetrics-text|text/plain); ?(version|q)=.{0,8}"))
def test_no_header_breaks_a_scrape(text: str) -> None:
    assert negotiate(text) in (TEXT, OPENMETRICS)
    assert accepts_gzip(text) in (True, False)


@given(st.floats(allow_nan=False))
def test_a_number_is_read_back_as_it_was(value: float) -> None:
    assert float(number(value)) == value


@pytest.mark.parametrize(
    ("value", "text"),
    [(float("inf"), b" +Inf\n"), (float("-inf"), b" -Inf\n"), (float("nan"), b" NaN\n"), (True, b" 1.0\n")],
)
def test_special_numbers(value: float, text: bytes) -> None:
    assert number(value) == text


def test_headers_of_a_counter() -> None:
    info = counter("sun_energy_joules_total", 'What "energy" is,\nwith \\.')
    assert header(info, TEXT).decode().splitlines() == [
        r'# HELP sun_energy_joules_total What "energy" is,\nwith \\.',
        "# TYPE sun_energy_joules_total counter",
    ]
    assert header(counter("sun_energy_watthours_total", 'An "energy".'), OPENMETRICS).decode().splitlines() == [
        r"# HELP sun_energy_watthours An \"energy\".",
        "# TYPE sun_energy_watthours counter",
        "# UNIT sun_energy_watthours watthours",
    ]


def test_samples() -> None:
    labels = label_pairs(("site", "line"), ('a"b', "c\\d\ne"))
    assert sample_lines(gauge("up", "."), labels, 1) == b'up{site="a\\"b",line="c\\\\d\\ne"} 1.0\n'
    assert sample_lines(gauge("up", "."), b"", 0.5) == b"up 0.5\n"


def test_a_histogram_counts_up_to_infinity() -> None:
    kept = Histogram()
    for seconds in (0.004, 0.005, 0.3, 11.0):
        kept.observe(seconds)
    lines = sample_lines(histogram("wait_seconds", "."), b'line="a"', kept).decode().splitlines()
    assert lines[0] == 'wait_seconds_bucket{line="a",le="0.005"} 2.0'
    assert lines[-3:] == [
        'wait_seconds_bucket{line="a",le="+Inf"} 4.0',
        'wait_seconds_sum{line="a"} 11.309',
        'wait_seconds_count{line="a"} 4.0',
    ]
    assert b'wait_seconds_bucket{le="10.0"} 3.0\n' in sample_lines(histogram("wait_seconds", "."), b"", kept)
