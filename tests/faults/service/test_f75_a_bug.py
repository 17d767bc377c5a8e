"""F75: a task that dies of a bug again and again ends the process in order, with 70."""

from __future__ import annotations

import asyncio
import sys
from pathlib import Path

from tests.e2e.programs import Program
from tests.faults.service.rig import QUIET, Service, client

BROKEN = """
from gateway.core.engine import LineEngine
from gateway.service import supervisor

supervisor.FIRST_DELAY_S = 0.05

def fall(self, now):
    raise ZeroDivisionError("a bug")

LineEngine.opened = fall
from gateway.cli.main import main
main()
"""
"""The gateway with a line whose engine cannot be opened, and less patience between two tries."""


async def test_five_times_in_a_minute_is_exit_status_70(service: Service, tmp_path: Path) -> None:
    service.configure(rest=QUIET)
    program = Program([sys.executable, "-c", BROKEN, "run", "-c", str(service.config)])
    service.programs.append(program)
    await service.log("event=listening listener=.modbus")
    async with client(service.modbus) as asker:
        assert await asker.read(11) == b"\x83\x0a"  # the faces go on meanwhile
        await service.log("event=giving_up task=.line shelter-a. failures=5")
        assert await asker.reply() == b""
    await asyncio.to_thread(program.process.wait, 10)
    assert await service.ended() == 70
    log = program.log()
    assert log.count("event=task_failed") == 5
    assert log.count("Traceback") == 1
    assert program.seen[-1].endswith("event=stopped status=70")
