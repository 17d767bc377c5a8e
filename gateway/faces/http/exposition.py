"""One scrape, made and handed out piece by piece, so that the loop is never held for long.

Rule 1: first the snapshots of all devices are taken, which are never changed; so nothing of the reply depends on later
        polls, and it is of one moment.
Rule 2: the reply is written and goes out in pieces of about `PIECE_BYTES`, each compressed in its own turn; no copy of
        the whole is ever made, and none of a piece is kept.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Iterator

from prometheus_client import CollectorRegistry, GCCollector, ProcessCollector
from prometheus_client.exposition import generate_latest
from prometheus_client.openmetrics.exposition import generate_latest as generate_openmetrics

from gateway.clock import Clock
from gateway.core.site import Site
from gateway.faces.http.devices import DeviceMetrics
from gateway.faces.http.metric import MetricInfo
from gateway.faces.http.own import Counts, OwnMetrics
from gateway.faces.http.packing import packer
from gateway.faces.http.text import Format, Lines, header

PIECE_BYTES = 256 * 1024
CLOCK_STEP_S = 60.0
"""By so much the wall clock is set; by less it is disciplined."""


class Exposition:
    """All metrics of one gateway."""

    def __init__(self, site: Site, clock: Clock, counts: Counts) -> None:
        """Prepare all series; MapError when two models give one metric name different labels or types."""
        self._clock = clock
        self._site = site
        self._devices = DeviceMetrics(site)
        self._began = clock.monotonic()
        self._offset_s = clock.wall() - self._began
        self._own = OwnMetrics(site, counts, self._started_at)
        self._process = CollectorRegistry()
        ProcessCollector(registry=self._process)
        GCCollector(registry=self._process)

    def adjust(self, site: Site, counts: Counts) -> None:
        """Tell of another site from now on; a scrape under way ends as it began. MapError as for a new one."""
        if site is not self._site:
            self._devices = DeviceMetrics(site)
        self._site = site
        self._own = OwnMetrics(site, counts, self._started_at)

    def _started_at(self) -> float:
        """When the gateway started, by the clock as it is set now: one that was wrong then is not believed for ever."""
        offset_s = self._clock.wall() - self._clock.monotonic()
        if abs(offset_s - self._offset_s) > CLOCK_STEP_S:
            self._offset_s = offset_s
        return self._began + self._offset_s

    async def pieces(self, form: Format) -> AsyncIterator[bytes]:
        """The exposition in pieces of about `PIECE_BYTES`, a turn of the loop between two of them."""
        devices, own = self._devices, self._own
        piece: list[bytes] = []
        size = 0
        now = self._clock.monotonic()
        for block in self._blocks(form, devices.families(devices.look(), now), own.families(now)):
            piece.append(block)
            size += len(block)
            if size >= PIECE_BYTES:
                whole = b"".join(piece)
                piece.clear()
                size = 0
                yield whole
                await asyncio.sleep(0)
        yield b"".join(piece)

    def _blocks(self, form: Format, *metrics: Iterator[tuple[MetricInfo, Lines]]) -> Iterator[bytes]:
        for families in metrics:
            for info, lines in families:
                yield header(info, form)
                yield b"".join(lines)
        if form.openmetrics:
            text: bytes = generate_openmetrics(self._process)  # type: ignore[no-untyped-call]  # as upstream left it
            yield text.removesuffix(form.end)
        else:
            yield generate_latest(self._process)
        yield form.end


async def compressed(pieces: AsyncIterator[bytes]) -> AsyncIterator[bytes]:
    """The pieces as one gzip stream, each compressed before the next is made."""
    stream = packer()
    async for piece in pieces:
        for at in range(0, len(piece), PIECE_BYTES):
            packed = stream.compress(memoryview(piece)[at : at + PIECE_BYTES])
            if packed:
                yield packed
            await asyncio.sleep(0)
    yield stream.flush()
