"""Scrapes without a connection, parsed by prometheus-client's own parsers."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator

from prometheus_client.metrics_core import Metric
from prometheus_client.openmetrics import parser as openmetrics
from prometheus_client.parser import text_string_to_metric_families

from gateway.faces.http.exposition import Exposition
from gateway.faces.http.text import TEXT, Format

Seen = dict[tuple[str, tuple[tuple[str, str], ...]], float]
"""(sample name, sorted labels) → number."""


async def joined(pieces: AsyncIterator[bytes]) -> bytes:
    """The whole of a reply."""
    return b"".join([piece async for piece in pieces])


def scrape(exposition: Exposition, form: Format = TEXT) -> bytes:
    """The whole exposition."""
    return asyncio.run(joined(exposition.pieces(form)))


def parse(text: bytes, form: Format = TEXT) -> list[Metric]:
    """Parse by the strict parser of the format; ValueError on anything that it does not allow."""
    if form.openmetrics:
        return list(openmetrics.text_string_to_metric_families(text.decode()))  # type: ignore[no-untyped-call]  # as upstream left it
    return list(text_string_to_metric_families(text.decode()))


def seen(families: list[Metric]) -> Seen:
    """All samples; AssertionError when a series is there twice."""
    found: Seen = {}
    for family in families:
        for sample in family.samples:
            key = (sample.name, tuple(sorted(sample.labels.items())))
            assert key not in found, "a series was given twice"
            found[key] = sample.value
    return found
