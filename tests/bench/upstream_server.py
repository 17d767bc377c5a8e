"""A Modbus TCP server with four units: `upstream_server.py PORT LATENCY_MS keeps|closes`.

Each register holds a word made of its unit and address, so that a reply tells whose it is. It answers each request
after the latency, whatever else is under way.
"""

from __future__ import annotations

import asyncio
import struct
import sys
from collections.abc import Coroutine
from importlib.util import find_spec
from typing import cast

from gateway.modbus.mbap import Adu, MbapSplitter, encode

UNITS = range(1, 5)
_ALL = {
    unit: struct.pack(">65536H", *((address * 0x9E37 + unit * 0x1234) & 0xFFFF for address in range(0x10000)))
    for unit in UNITS
}


def words(unit: int, first: int, count: int) -> bytes:
    """What the registers hold."""
    return _ALL[unit][2 * first : 2 * (first + count)]


def run(main: Coroutine[object, object, None]) -> None:
    """On the fastest loop there is."""
    if find_spec("uvloop"):
        import uvloop

        uvloop.run(main)
    else:
        asyncio.run(main)


class Server(asyncio.Protocol):
    """One connection."""

    latency_s = 0.0
    closes = False

    def __init__(self) -> None:
        self._splitter = MbapSplitter()
        self._transport: asyncio.Transport | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast("asyncio.Transport", transport)  # uvloop's is none by its class

    def data_received(self, data: bytes) -> None:
        adus = self._splitter.feed(data)
        if self.latency_s:
            asyncio.get_running_loop().call_later(self.latency_s, self._answer, adus)
        else:
            self._answer(adus)

    def _answer(self, adus: list[Adu]) -> None:
        if self._transport is None or self._transport.is_closing():
            return
        self._transport.write(b"".join([encode(tid, unit, _reply(unit, pdu)) for tid, unit, pdu in adus]))
        if self.closes:
            self._transport.close()


def _reply(unit: int, pdu: bytes) -> bytes:
    if unit not in UNITS:
        return bytes((pdu[0] | 0x80, 0x0B))
    if pdu[0] > 4:
        return bytes((pdu[0] | 0x80, 0x01))
    _, first, count = struct.unpack(">BHH", pdu)
    data = words(unit, first, count) if pdu[0] > 2 else bytes((count + 7) // 8)
    return bytes((pdu[0], len(data))) + data


async def main(port: int, latency_ms: float, habit: str) -> None:
    Server.latency_s = latency_ms / 1000
    Server.closes = habit == "closes"
    server = await asyncio.get_running_loop().create_server(Server, "127.0.0.1", port, backlog=1024)
    await server.serve_forever()


if __name__ == "__main__":
    run(main(int(sys.argv[1]), float(sys.argv[2]), sys.argv[3]))
