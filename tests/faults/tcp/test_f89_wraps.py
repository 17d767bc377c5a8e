"""F89: transaction ids beyond 255 and from 65535 to 0, and a clock that has run for 497 days: nothing stalls."""

from __future__ import annotations

from itertools import chain

from gateway.modbus import mbap
from tests.faces.modbus.conftest import Running, read

TIDS = (*range(250, 260), *range(65526, 65536), *range(10))


async def test_every_transaction_id_comes_back_from_memory_and_from_the_line(running: Running) -> None:
    running.world.poll(11)
    client = await running.connect()
    (memory, memory_reply), (line, line_reply) = read(11, 0, 2), read(11, 0xE000, 2)
    for tid in TIDS:
        client.ask(tid, 11, memory)
        client.ask(tid, 11, line)
        assert await client.adus(2) == [mbap.Adu(tid, 11, memory_reply), mbap.Adu(tid, 11, line_reply)]
    for start in range(0, len(TIDS), 5):  # and with several under way
        some = TIDS[start : start + 5]
        for tid in some:
            client.ask(tid, 11, line)
            client.ask(tid, 11, memory)
        wanted = chain.from_iterable((mbap.Adu(t, 11, line_reply), mbap.Adu(t, 11, memory_reply)) for t in some)
        assert await client.adus(2 * len(some)) == list(wanted)


async def test_after_497_days_a_client_is_served_as_before(running: Running) -> None:
    running.world.clock.now += 2**32 / 100 - 0.05  # hundredths of a second wrap in 32 bits
    for _ in range(3):
        running.world.poll(11)
        client = await running.connect()
        pdu, reply = read(11, 0, 2)
        client.ask(1, 11, pdu)
        assert await client.adus(1) == [mbap.Adu(1, 11, reply)]
        running.world.clock.now += 0.05
