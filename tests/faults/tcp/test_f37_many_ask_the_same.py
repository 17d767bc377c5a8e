"""F37: many clients ask the same block: one serial read answers all; one that leaves does not cancel it."""

from __future__ import annotations

from gateway.modbus import mbap
from tests.faces.modbus.conftest import Running, read


async def test_many_clients_ask_the_same_and_the_line_once(running: Running) -> None:
    line = running.world.line(11)
    line.held = True
    clients = [await running.connect() for _ in range(8)]
    request, reply = read(11, 0xE000 & 0x3F, 10)
    for tid, client in enumerate(clients):
        client.ask(tid, 11, request)
    await running.until(lambda: bool(line.waiting) and len(line.waiting[0].waiters) == 8)
    clients[3].reset()
    await running.until(lambda: running.world.stats.open_connections == 7)
    line.release()
    for tid, client in enumerate(clients):
        if tid != 3:
            assert await client.adu() == mbap.Adu(tid, 11, reply)
    assert line.transactions == [(1, request)]
