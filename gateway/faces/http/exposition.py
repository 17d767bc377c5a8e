"""One scrape, made and handed out piece by piece, so that the loop is never held for long.

Rule 1: first the snapshots of all devices are taken, which are never changed; so nothing of the reply depends on later
        polls, and it is of one moment.
Rule 2: the reply is written and goes out in pieces of about `PIECE_BYTES`, each compressed in its own turn; no copy of
        the whole is ever made, and none of a piece is kept.
Rule 3: a turn of the loop writes about `TURN_BYTES`, about a tenth of a millisecond, so that a Modbus client
        waits for a scrape no longer than for the other clients.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Iterator

from gateway.clock import Clock
from gateway.core.site import Site
from gateway.faces.http.devices import DeviceMetrics
from gateway.faces.http.metric import MetricInfo
from gateway.faces.http.own import Counts, OwnMetrics
from gateway.faces.http.packing import packer
from gateway.faces.http.process import process_families
from gateway.faces.http.text import Format, Lines, header

PIECE_BYTES = 64 * 1024
TURN_BYTES = 24 * 1024
PACKED_BYTES = 16 * 1024
"""So much is collected before it is sent, where it is compressed."""

LOOKS_A_TURN = 16
"""Devices whose conditions are looked at in one turn."""

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
        self._own = OwnMetrics(site, counts, self._began, self._wall)

    def adjust(self, site: Site, counts: Counts) -> None:
        """Tell of another site from now on; a scrape under way ends as it began. MapError as for a new one."""
        if site is not self._site:
            self._devices = DeviceMetrics(site)
        self._site = site
        self._own = OwnMetrics(site, counts, self._began, self._wall)

    def _wall(self, at: float) -> float:
        """Wall time of a monotonic moment, by the clock as it is set now: one that was wrong then is not believed."""
        offset_s = self._clock.wall() - self._clock.monotonic()
        if abs(offset_s - self._offset_s) > CLOCK_STEP_S:
            self._offset_s = offset_s
        return at + self._offset_s

    async def pieces(self, form: Format) -> AsyncIterator[bytes]:
        """The exposition in pieces of about `PIECE_BYTES`, a turn of the loop between two of them."""
        devices, own = self._devices, self._own
        now = self._clock.monotonic()
        for looked, _ in enumerate(own.look(now), 1):
            if looked % LOOKS_A_TURN == 0:
                await asyncio.sleep(0)
        piece: list[bytes] = []
        size = made = 0
        now, moment = self._clock.monotonic(), devices.look()
        await asyncio.sleep(0)
        for block in self._blocks(form, devices.families(moment, now), own.families(now), process_families()):
            piece.append(block)
            size += len(block)
            made += len(block)
            if size >= PIECE_BYTES:
                whole = b"".join(piece)
                piece.clear()
                size = 0
                yield whole
            if made >= TURN_BYTES:
                made = 0
                await asyncio.sleep(0)
        yield b"".join(piece)

    def _blocks(self, form: Format, *metrics: Iterator[tuple[MetricInfo, Lines]]) -> Iterator[bytes]:
        for families in metrics:
            begun: MetricInfo | None = None
            for info, lines in families:
                if info is not begun:
                    begun = info
                    yield header(info, form)
                yield b"".join(lines)
        yield form.end


async def compressed(pieces: AsyncIterator[bytes]) -> AsyncIterator[bytes]:
    """The pieces as one gzip stream, each compressed before the next is made."""
    stream, step = packer()
    packed = b""
    async for piece in pieces:
        for at in range(0, len(piece), step):
            packed += stream.compress(memoryview(piece)[at : at + step])
            if len(packed) >= PACKED_BYTES:
                yield packed
                packed = b""
            await asyncio.sleep(0)
    yield packed + stream.flush()
