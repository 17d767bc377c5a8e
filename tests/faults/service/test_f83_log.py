"""F83: a journal that does not read, and a log pipe that is closed."""

from __future__ import annotations

import asyncio
import os
import re
from contextlib import suppress

from tests.e2e.programs import GATEWAY, Program
from tests.faults.service.rig import Service, client
from tests.machine import Bystander

STOP_S = 10.0
"""By when it has ended (F72); a small part of it where nothing else runs."""


async def test_nobody_waits_for_who_reads_the_log(service: Service, passing: Bystander) -> None:
    service.configure(rest="[poll]\nlive_s = 0.2\n")
    fifo = service.folder / "log"
    os.mkfifo(fifo)
    reader = os.open(fifo, os.O_RDWR | os.O_NONBLOCK)
    with suppress(BlockingIOError):
        while True:
            os.write(reader, b"." * 4096)  # nobody reads: it is full before the first line
    run = [*GATEWAY, "run", "-c", str(service.config), "--log-level", "debug"]
    program = Program(["sh", "-c", 'exec "$0" "$@" 2>"$FIFO"', *run], FIFO=str(fifo))
    service.programs.append(program)
    await service.online()
    async with client(service.modbus) as asker:
        for _ in range(200):
            assert (await asker.read(11))[:2] == b"\x03\x04"
    assert (await service.get("/healthz"))[0] == 200
    os.close(reader)  # and now it is closed
    async with client(service.modbus) as asker:
        assert (await asker.read(11))[:2] == b"\x03\x04"
    dropped = re.compile(r"^prostar_gateway_log_lines_dropped_total [1-9]", re.MULTILINE)
    async with asyncio.timeout(30):
        while not dropped.search((await service.get("/metrics"))[1]):  # noqa: ASYNC110 - the process has no event for it
            await asyncio.sleep(0.05)
    passing.start()
    assert await service.end() == 0
    assert passing.stop() < STOP_S


async def test_a_reader_that_never_comes_does_not_keep_it_from_stopping(service: Service, passing: Bystander) -> None:
    service.configure()
    fifo = service.folder / "log"
    os.mkfifo(fifo)
    reader = os.open(fifo, os.O_RDWR | os.O_NONBLOCK)
    with suppress(BlockingIOError):
        while True:
            os.write(reader, b"." * 4096)
    program = Program(
        ["sh", "-c", 'exec "$0" "$@" 2>"$FIFO"', *GATEWAY, "run", "-c", str(service.config)], FIFO=str(fifo)
    )
    service.programs.append(program)
    await service.online()
    passing.start()
    assert await service.end() == 0
    assert passing.stop() < STOP_S
    os.close(reader)


async def test_no_value_of_a_register_is_logged(service: Service) -> None:
    """Polls, reads of clients, a refused write and a stop at the level of operation."""
    service.configure(rest="[poll]\nlive_s = 0.2\n")
    program = service.start()
    await service.online()
    async with client(service.modbus) as asker:
        for first in (0x0000, 0xE000):
            assert (await asker.read(11, first, 40))[0] == 3
        asker.ask(11, bytes.fromhex("06 E000 7A69"))
        assert await asker.reply() == b"\x86\x01"
    service.lines["shelter-a"].unplug()
    await service.log("event=line_down")
    assert await service.end() == 0
    lines = [line for line in program.log().splitlines() if "event=listening" not in line]
    said = re.findall(r"[0-9]+", "\n".join(lines))
    unit = service.units["shelter-a"][0]
    words = [unit.word(at) for at in (*range(40), *range(0xE000, 0xE028))]
    values = {str(word) for word in words if word > 1999} | {"31337", "7A69"}
    assert len(values) > 60
    assert values.isdisjoint(said)
    assert not re.search(r"[0-9A-Fa-f]{8}", re.sub(r"time=\S+", "", program.log()).replace(str(service.folder), ""))
