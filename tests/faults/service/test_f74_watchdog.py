"""F74: systemd hears when the start is over, while all works, and when it ends; dead hardware is none of it."""

from __future__ import annotations

import asyncio
import re
import sys

from tests.e2e.programs import Program, StandsStill
from tests.faults.service.rig import QUIET, NotifySocket, Service


async def test_ready_alive_stopping(service: Service, systemd: NotifySocket) -> None:
    service.configure()
    program = service.start(NOTIFY_SOCKET=systemd.path, WATCHDOG_USEC="400000")
    ready = await systemd.next("READY=1")
    assert re.fullmatch(r"READY=1\nSTATUS=[01] of 1 controllers online(; 1 of 1 lines down)?", ready)
    assert (await service.get("/readyz"))[0] == 200  # it is true when it is said
    loop = asyncio.get_running_loop()
    began = loop.time()
    for _ in range(8):
        await systemd.next("WATCHDOG=1")
    assert 0.5 < loop.time() - began < 16.0  # 1.6 s where nothing else runs
    program.process.terminate()
    await systemd.next("STOPPING=1")
    assert await service.ended() == 0


async def test_an_unplugged_line_and_a_dead_controller_do_not_starve_it(
    service: Service, systemd: NotifySocket
) -> None:
    service.configure(
        devices=(("shelter-a", "array-1", 1, 11), ("shelter-a", "ghost", 9, 19), ("shelter-b", "array-3", 1, 13)),
        line_keys="baudrate = 115200\nreply_timeout_s = 0.1",
        rest="[poll]\nlive_s = 0.2\n",
    )
    service.start(NOTIFY_SOCKET=systemd.path, WATCHDOG_USEC="400000")
    await systemd.next("READY=1")
    await service.log("device_offline .*device=ghost")
    service.lines["shelter-a"].unplug()
    await service.log("line_down line=shelter-a")
    systemd.drain()
    told = ""
    for _ in range(6):
        told = await systemd.next("WATCHDOG=1")
    # And whoever looks at `systemctl status` sees it: the third controller's line is not there at all.
    assert told == "WATCHDOG=1\nSTATUS=0 of 3 controllers online; 2 of 2 lines down"
    assert (await service.get("/healthz"))[0] == 200
    assert (await service.get("/readyz"))[0] == 200


HANGING = """
from gateway.lines.serial import SerialLine
SerialLine.overdue_s = lambda self, now: 60.0
from gateway.cli.main import main
main()
"""
"""The gateway with a line that leaves undone what it should have done long ago."""


async def test_a_line_that_hangs_starves_it_although_the_loop_turns(service: Service, systemd: NotifySocket) -> None:
    service.configure(rest=QUIET)
    program = Program(
        [sys.executable, "-c", HANGING, "run", "-c", str(service.config)],
        NOTIFY_SOCKET=systemd.path,
        WATCHDOG_USEC="400000",
    )
    service.programs.append(program)
    await service.log('event=watchdog_not_fed stuck="line shelter-a"')
    systemd.drain()
    await asyncio.sleep(0.5)
    assert (await service.get("/healthz"))[0] == 200
    assert [told for told in systemd.drain() if "WATCHDOG" in told] == []
    assert await service.end() == 0


async def test_a_loop_that_stands_still_starves_it_whatever_other_threads_do(
    service: Service, systemd: NotifySocket
) -> None:
    service.configure(rest=QUIET)
    still = StandsStill(service.folder)
    program = Program(
        [*still.command, "run", "-c", str(service.config)], NOTIFY_SOCKET=systemd.path, WATCHDOG_USEC="200000"
    )
    service.programs.append(program)
    await systemd.next("WATCHDOG=1")
    program.process.send_signal(still.SIGNAL)
    await service.log(still.SAID)
    systemd.drain()
    await asyncio.sleep(0.5)  # ten times as long as it would take it to tell
    assert systemd.drain() == []
    await asyncio.to_thread(still.go_on)
    await systemd.next("WATCHDOG=1")
    assert await service.end() == 0
