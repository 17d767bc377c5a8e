"""What a page of Python with pymodbus gives: Modbus TCP in front of a serial line. `pymodbus_bridge.py PORT LINE`.

Requests wait for each other at a lock, as in mbusd; there is no memory. Only function 03 is spoken.
"""

from __future__ import annotations

import asyncio
import sys

from pymodbus.client import AsyncModbusSerialClient
from pymodbus.exceptions import ModbusException

TIMEOUT_S = 0.5
GATEWAY_TARGET_FAILED = 0x0B


class Bridge:
    """One line, any number of clients."""

    def __init__(self, line: str) -> None:
        self._client = AsyncModbusSerialClient(line, baudrate=9600, stopbits=2, timeout=TIMEOUT_S, retries=0)
        self._free = asyncio.Lock()

    async def start(self, port: int) -> None:
        await self._client.connect()
        server = await asyncio.start_server(self._serve, "127.0.0.1", port)
        await server.serve_forever()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            while True:
                header = await reader.readexactly(7)
                request = await reader.readexactly(int.from_bytes(header[4:6]) - 1)
                reply = await self._answer(header[6], request)
                writer.write(header[:4] + (len(reply) + 1).to_bytes(2) + header[6:7] + reply)
                await writer.drain()
        except (asyncio.IncompleteReadError, ConnectionError):
            writer.close()

    async def _answer(self, unit: int, request: bytes) -> bytes:
        address, count = int.from_bytes(request[1:3]), int.from_bytes(request[3:5])
        async with self._free:
            try:
                reply = await self._client.read_holding_registers(address, count=count, device_id=unit)
            except ModbusException:
                return bytes((request[0] | 0x80, GATEWAY_TARGET_FAILED))
        if reply.isError():
            return bytes((request[0] | 0x80, GATEWAY_TARGET_FAILED))
        data = b"".join(word.to_bytes(2) for word in reply.registers)
        return bytes((request[0], len(data))) + data


async def main() -> None:
    await Bridge(sys.argv[2]).start(int(sys.argv[1]))  # pymodbus makes its client only within a loop


if __name__ == "__main__":
    asyncio.run(main())
