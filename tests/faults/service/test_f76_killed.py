"""F76: after kill -9 the next start has the port at once, and fresh data soon; nothing is left behind."""

from __future__ import annotations

import signal

from tests.faults.service.rig import Service, client, descriptors
from tests.machine import Bystander


async def test_a_killed_gateway_leaves_nothing_and_its_successor_serves_soon(
    service: Service, passing: Bystander
) -> None:
    service.configure(rest="[poll]\nlive_s = 0.2\n")
    program = service.start()
    await service.online()
    assert service.lines["shelter-a"].device in descriptors(program.process.pid).values()
    assert await service.end(signal.SIGKILL) == -signal.SIGKILL
    left = {path.name for path in service.folder.iterdir()} | {
        path.name for path in (service.folder / "state").iterdir()
    }
    assert not [name for name in left if "lock" in name.lower() or name.endswith(".pid")]
    passing.start()
    program = service.start()
    await service.online()
    async with client(service.modbus) as asker:
        assert (await asker.read(11))[0] == 3
    assert passing.stop() < 15.0
    assert "line_down" not in program.log()
    assert await service.end() == 0
