"""F73: a second signal, of either kind, ends the process at once and quietly; so does one while it starts."""

from __future__ import annotations

import asyncio
import os
import signal
import time

import pytest

from tests.faults.service.rig import Service, client, read
from tests.optional import optional


@pytest.mark.parametrize("second", [signal.SIGTERM, signal.SIGINT])
async def test_a_second_signal_does_not_wait(service: Service, second: signal.Signals) -> None:
    service.configure()
    program = service.start()
    await service.online()
    unit = service.units["shelter-a"][0]
    await unit.is_quiet()
    unit.turnaround_s = 30.0
    async with client(service.modbus) as asker:
        asker.ask(11, read(0xE000, 2))
        await unit.is_asked(read(0xE000, 2))
        program.process.terminate()
        await service.log("event=stopping signal=SIGTERM")
        assert await service.end(second) == 0
        assert await asker.reply() == b""  # who waits for the first signal alone is answered 06 after four seconds
    assert "Traceback" not in program.log()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
@pytest.mark.parametrize("loop", ["asyncio", "uvloop"])
async def test_a_signal_when_all_is_over_changes_nothing(service: Service, number: signal.Signals, loop: str) -> None:
    """The interpreter takes a while to end: what comes then is not what it ends by."""
    if loop == "uvloop":
        optional("uvloop")
    service.configure()
    program = service.start("--loop", loop)
    await service.log("event=line_up")
    program.process.terminate()
    await service.log("event=stopped")
    while program.process.poll() is None:
        program.process.send_signal(number)
        await asyncio.sleep(0.001)
    assert await service.ended() == 0
    assert "Traceback" not in program.log()


async def test_a_signal_at_any_moment_of_the_start_ends_it_quietly(service: Service) -> None:
    service.configure()
    began = time.monotonic()
    program = service.start()
    await service.log("event=line_up")
    assert await service.end() == 0
    whole_s = time.monotonic() - began
    # Before Python itself is up nobody handles signals: a fiftieth of the time.
    for part, number in ((0.3, signal.SIGINT), (0.4, signal.SIGTERM), (0.7, signal.SIGINT), (0.9, signal.SIGTERM)):
        program = service.start()
        await asyncio.sleep(part * whole_s)
        assert await service.end(number) == 0
        assert "Traceback" not in program.log()


async def test_a_reload_that_is_wanted_while_it_starts_is_made_then(service: Service) -> None:
    service.configure()
    text = service.config.read_bytes()
    service.config.unlink()
    os.mkfifo(service.config)
    program = service.start()
    writing = await asyncio.to_thread(os.open, service.config, os.O_WRONLY)  # it is being read
    program.process.send_signal(signal.SIGHUP)
    service.config.unlink()
    service.config.write_bytes(text)
    os.write(writing, text)
    os.close(writing)
    await service.log("event=started")
    await service.log("event=reloaded")
    assert await service.end() == 0
