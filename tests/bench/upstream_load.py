"""Clients that read ranges which nobody read before: `upstream_load.py PORT CLIENTS SECONDS UNIT…`; prints JSON.

Each client has one request under way, takes the units in turn, and checks that the words are those of the unit and
addresses that it asked for.
"""

from __future__ import annotations

import asyncio
import json
import random
import struct
import sys
import time
from dataclasses import dataclass, field
from typing import cast

from gateway.modbus.mbap import MbapSplitter, encode
from tests.bench.upstream_server import run, words

COUNT = 10
FIRST, LAST = 0x0100, 0x7000  # outside of the map, so that nothing of it is polled
PATIENCE_S = 5.0


@dataclass
class Seen:
    """What became of the requests."""

    took_s: list[float] = field(default_factory=list)
    errors: int = 0
    wrong: int = 0


class Client(asyncio.Protocol):
    """One client: asks again when it was answered."""

    def __init__(self, number: int, units: list[int], seen: Seen) -> None:
        self._number = number
        self._units = units
        self._seen = seen
        self._rng = random.Random(number)
        self._splitter = MbapSplitter()
        self._transport: asyncio.Transport | None = None
        self._tid = self._first = 0
        self._began = 0.0
        self.waiting = False
        self.over = False

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast("asyncio.Transport", transport)  # uvloop's is none by its class
        self._ask()

    def connection_lost(self, exc: Exception | None) -> None:
        self._transport = None

    def data_received(self, data: bytes) -> None:
        for tid, unit, pdu in self._splitter.feed(data):
            self.waiting = False
            if pdu[0] & 0x80:
                self._seen.errors += 1
            else:
                self._seen.took_s.append(time.monotonic() - self._began)
                place = (self._tid + self._number) % len(self._units)
                right = tid == self._tid and unit == self._units[place]
                self._seen.wrong += not right or pdu[2:] != words(place + 1, self._first, COUNT)
            if not self.over:
                self._ask()

    def _ask(self) -> None:
        if self._transport is None:
            return
        self._tid = (self._tid + 1) & 0xFFFF
        self._first = self._rng.randrange(FIRST, LAST)
        unit = self._units[(self._tid + self._number) % len(self._units)]
        self._began = time.monotonic()
        self.waiting = True
        self._transport.write(encode(self._tid, unit, struct.pack(">BHH", 3, self._first, COUNT)))


async def main(port: int, clients: int, seconds: float, units: list[int]) -> None:
    seen = Seen()
    loop = asyncio.get_running_loop()
    began = time.monotonic()
    made = [await loop.create_connection(lambda k=k: Client(k, units, seen), "127.0.0.1", port) for k in range(clients)]  # type: ignore[misc]
    await asyncio.sleep(seconds)
    lasted_s = time.monotonic() - began
    answered = len(seen.took_s)
    for _, client in made:
        client.over = True
    until = time.monotonic() + PATIENCE_S
    while any(client.waiting for _, client in made) and time.monotonic() < until:  # noqa: ASYNC110  # many may be the last
        await asyncio.sleep(0.05)
    took = sorted(seen.took_s) or [0.0]
    result = {
        "rate": answered / lasted_s,
        "p50_ms": 1e3 * took[len(took) // 2],
        "p99_ms": 1e3 * took[int(0.99 * len(took))],
        "errors": seen.errors,
        "timed_out": sum(client.waiting for _, client in made),
        "wrong": seen.wrong,
    }
    sys.stdout.write(json.dumps(result) + "\n")


if __name__ == "__main__":
    run(main(int(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3]), [int(unit) for unit in sys.argv[4:]]))
