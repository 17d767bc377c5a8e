"""F81: file descriptors run out: connections wait, nothing spins, and line, metrics and SNMP keep theirs."""

from __future__ import annotations

import asyncio
import os
import resource
import shutil
from contextlib import suppress
from pathlib import Path

from gateway.faces.modbus.accepting import SPARE_DESCRIPTORS
from tests.e2e.programs import GATEWAY, Program
from tests.faults.service.rig import Service, client, descriptors

LIMIT = 120
"""Of the gateway: a few dozen for itself, `SPARE_DESCRIPTORS` that no Modbus client gets, some for clients."""

CROWD = 150


def cpu_s(pid: int) -> float:
    """What the process has used."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


async def test_connections_wait_and_everything_else_goes_on(service: Service) -> None:
    assert resource.getrlimit(resource.RLIMIT_NOFILE)[0] > CROWD + 100
    prlimit = shutil.which("prlimit", path="/usr/bin:/bin")
    assert prlimit is not None
    service.configure(rest="[poll]\nlive_s = 0.2\n", modbus_keys="max_connections = 1024\nmax_per_client = 1024")
    program = Program([prlimit, f"--nofile={LIMIT}", *GATEWAY, "run", "-c", str(service.config)])
    service.programs.append(program)
    await service.online()
    pid = program.process.pid
    writers: list[asyncio.StreamWriter] = []
    try:
        async with client(service.modbus) as first:
            writers += [(await asyncio.open_connection("127.0.0.1", service.modbus))[1] for _ in range(CROWD)]
            await service.log('event=accept_paused .*reason="only spare descriptors are left"')
            before = cpu_s(pid)
            await asyncio.sleep(2.5)  # two pauses and more
            assert cpu_s(pid) - before < 1.2  # turning round and round would take all of it
            assert len(descriptors(pid)) <= LIMIT - SPARE_DESCRIPTORS + 8
            # The line is opened anew, and metrics are scraped, while clients are waiting.
            service.lines["shelter-a"].unplug()
            await service.log("event=line_down line=shelter-a")
            service.lines["shelter-a"].replug()
            await service.log("event=line_up line=shelter-a")
            await service.online()
            assert "morningstar_up" in (await service.get("/metrics"))[1]
            assert (await first.read(11))[:2] == b"\x03\x04"
    finally:
        for writer in writers:
            writer.close()
            with suppress(OSError):
                await writer.wait_closed()
    async with client(service.modbus) as late:
        assert (await late.read(11))[:2] == b"\x03\x04"
    assert await service.end() == 0
    assert "Traceback" not in program.log()
    assert "Too many open files" not in program.log()
