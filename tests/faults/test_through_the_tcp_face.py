"""From the registers to a Modbus TCP client and back, over a pty with faults: nothing foreign, torn, late or stale.

The real server, the real line and the real cache between them; the oracle judges what the clients get.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections import Counter
from collections.abc import AsyncIterator
from pathlib import Path
from random import Random

from gateway.core.settings import PollSettings
from gateway.core.site import Site
from gateway.core.stats import ModbusServerStats
from gateway.faces.modbus.server import ModbusServer
from gateway.faces.modbus.settings import ModbusSettings
from gateway.modbus import mbap
from gateway.simulator.chaos import LINE_FAULTS, Chaos, Fault, Spans
from tests.faults.pty_rig import PtyRig, running
from tests.faults.rig import Unit, read

MAX_AGE_S = 1.5
POLL = PollSettings(live_s=0.5, settings_s=5.0)
GATEWAY_EXCEPTIONS = {0x04, 0x06, 0x0A, 0x0B}


class Client:
    """One TCP connection; every reply is judged."""

    def __init__(self, rig: PtyRig, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.rig = rig
        self.reader = reader
        self.writer = writer
        self.tid = 0
        self.codes: Counter[int] = Counter()  # 0: a reply with data
        self.at: dict[int, tuple[float, int, bytes]] = {}

    def send(self, unit: int, pdu: bytes) -> None:
        self.tid += 1
        self.at[self.tid] = (self.rig.clock.monotonic(), unit, pdu)
        self.writer.write(mbap.encode(self.tid, 11 + unit, pdu))

    async def receive(self) -> None:
        async with asyncio.timeout(30):
            head = await self.reader.readexactly(7)
            reply = await self.reader.readexactly(int.from_bytes(head[4:6], "big") - 1)
        asked_at, unit, pdu = self.at.pop(int.from_bytes(head[:2], "big"))
        assert head[6] == 11 + unit
        if reply[0] & 0x80:
            assert reply[1] in GATEWAY_EXCEPTIONS
            self.codes[reply[1]] += 1
            return
        self.codes[0] += 1
        self.rig.judge(unit, pdu, reply, asked_at=asked_at, max_age_s=MAX_AGE_S)

    async def ask(self, unit: int, pdu: bytes) -> None:
        self.send(unit, pdu)
        await self.receive()


@contextlib.asynccontextmanager
async def served(rig: PtyRig) -> AsyncIterator[tuple[str, int]]:
    """The rig behind a Modbus TCP server; gives its address."""
    settings = ModbusSettings(listen=(("127.0.0.1", 0),), max_age_s=MAX_AGE_S)
    site = Site.of("ridge-07", [rig.line], rig.devices)
    server = ModbusServer(settings, site, rig.clock, ModbusServerStats())
    (listener,) = server.listeners
    await listener.start()
    try:
        assert listener.bound is not None
        yield listener.bound
    finally:
        await listener.stop()


async def test_clients_under_faults(tmp_path: Path) -> None:
    kinds = dict.fromkeys(LINE_FAULTS - {Fault.SILENCE, Fault.DUPLICATE}, 0.02)
    chaos = Chaos(25, kinds, spans=Spans(delay_s=(0.005, 0.05), late_s=(0.1, 0.5)))
    async with (
        running(tmp_path, Unit(0), Unit(1), medium=chaos, reply_timeout_s=0.1, poll=POLL) as rig,
        served(rig) as address,
    ):
        clients = [Client(rig, *await asyncio.open_connection(*address)) for _ in range(3)]

        async def work(number: int, client: Client) -> None:
            rng = Random(number)
            for _ in range(25):
                first = rng.choice((0x00, 0x10, 0x40, 0xE000, 0x8000 + 16 * rng.randrange(200)))
                pdu = read(first, rng.choice((2, 8, 16)), rng.choice((3, 4)))
                for _ in range(rng.choice((1, 1, 3))):  # the same again: joined, or from memory
                    client.send(rng.randrange(2), pdu)
                for _ in range(len(client.at)):
                    await client.receive()
                await asyncio.sleep(0.02)

        await asyncio.gather(*(work(number, client) for number, client in enumerate(clients)))
        for client in clients:
            client.writer.close()
            await client.writer.wait_closed()
        codes = sum((client.codes for client in clients), Counter())
        assert codes[0] > 40


async def test_f04_a_client_that_leaves_while_its_request_is_on_the_wire(tmp_path: Path) -> None:
    async with running(tmp_path, Unit(0, turnaround_s=0.1)) as rig, served(rig) as address:
        await rig.online()
        sent = rig.line.stats.sent
        gone = Client(rig, *await asyncio.open_connection(*address))
        gone.send(0, read(0x8000, 40))
        await rig.until(lambda: rig.line.stats.sent > sent)
        gone.writer.transport.abort()
        stays = Client(rig, *await asyncio.open_connection(*address))
        await rig.until(lambda: rig.line.stats.sent == rig.line.stats.ok + rig.line.stats.failed.total())
        sent = rig.line.stats.sent
        await stays.ask(0, read(0x8000, 40))  # from memory: what came is kept for the next who asks
        assert rig.line.stats.sent == sent
        for first in range(0x8100, 0x8140, 8):
            await stays.ask(0, read(first, 40))
        assert stays.codes == {0: 9}
        assert rig.line.stats.failed["timeout"] == 0
        stays.writer.close()
        await stays.writer.wait_closed()
