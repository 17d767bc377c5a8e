"""F80: a `state_dir` that is full, or cannot be had: data are served, and everybody is told."""

from __future__ import annotations

import asyncio
import re
import subprocess
from collections.abc import Callable

import pytest

from tests.e2e.programs import GATEWAY, Program
from tests.faults.service.rig import Service, client
from tests.faults.service.test_f78_reload import A1, LINE_KEYS, snmp_get, user

MOUNTED = ["unshare", "--mount", "sh", "-c", 'mount -t tmpfs -o "$HOW" none "$DIR" && exec "$0" "$@"']
"""Runs a program for which the folder $DIR is another disk, mounted as $HOW says."""

DISKS = {"full": "size=4k", "read-only": "ro"}

RAISED = re.compile(r'^prostar_gateway_condition\{.*condition="state_dir_unusable".*\} 1\.0$', re.MULTILINE)


def may_mount(folder: str) -> bool:
    """Whether a namespace and a file system in it can be made here."""
    variables = {"DIR": folder, "HOW": "ro", "PATH": "/usr/sbin:/usr/bin:/sbin:/bin"}
    done = subprocess.run([*MOUNTED, "true"], env=variables, check=False)
    return done.returncode == 0


@pytest.mark.peer
@pytest.mark.parametrize("kind", [*DISKS, "cannot be made"])
async def test_data_are_served_and_everybody_is_told(service: Service, peer: Callable[[str], str], kind: str) -> None:
    snmpget = peer("snmpget")
    table, noc = user("noc", service.folder, "correct-horse-1")
    service.configure((A1,), f"[poll]\nlive_s = 0.2\n{table}", LINE_KEYS)
    run = [*GATEWAY, "run", "-c", str(service.config)]
    if kind in DISKS:
        folder = service.folder / "state"
        folder.mkdir()
        if not may_mount(str(folder)):
            pytest.skip("needs the right to mount")
        program = Program([*MOUNTED, *run], DIR=str(folder), HOW=DISKS[kind])
    else:
        text = service.config.read_text()
        service.config.write_text(text.replace(f'state_dir = "{service.folder}/state"', 'state_dir = "/proc/none"'))
        program = Program(run)
    service.programs.append(program)
    await service.online()
    async with client(service.modbus) as asker:
        assert (await asker.read(11))[:2] == b"\x03\x04"
    assert await asyncio.to_thread(snmp_get, snmpget, service, *noc) == "ridge-07"  # with a new engine id, announced
    assert (await service.get("/healthz"))[0] == (await service.get("/readyz"))[0] == 200
    async with asyncio.timeout(30):
        while not RAISED.search((await service.get("/metrics"))[1]):  # noqa: ASYNC110 - the process has no event for it
            await asyncio.sleep(0.1)
    assert "prostar_gateway_history_store_up 0.0" in (await service.get("/metrics"))[1]
    assert await service.end() == 0
    log = program.log()
    for event in ("history_store_failed", "snmp_engine_new", "state_dir_unusable", "trace_off"):
        assert log.count(f"event={event}") == (0 if event == "trace_off" and kind == "full" else 1), event
    assert "Traceback" not in log
