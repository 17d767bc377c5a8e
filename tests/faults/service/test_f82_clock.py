"""F54, F82: the wall clock is set while the gateway works, by an hour, by a year, from 1970 to now: nobody notices.

libfaketime gives the process a wall clock that the test sets; its monotonic clock stays the machine's.
"""

from __future__ import annotations

import asyncio
import re
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.e2e.programs import Program, environment
from tests.faults.service.rig import Service, Unit, client, until
from tests.faults.service.test_f78_reload import LINE_KEYS, reading, user

LIBRARY = "libfaketimeMT.so.1"
START, DAY_S = -20_000 * 86_400, 86_400
GATEWAY = """
import select, time
time.sleep = lambda seconds: select.select([], [], [], seconds)
from gateway.cli.main import main
main()
"""
"""The gateway where the library is: clock_nanosleep, which Python sleeps by, refuses moments in it."""
STEPS = (0, 3_600, 0, 365 * DAY_S, 0)
"""What the clock is set to, in seconds from now: from 1972 to now, by an hour and a year forth and back."""


@pytest.fixture
def faked(peer: Callable[[str], str], tmp_path: Path) -> Callable[[int], dict[str, str]]:
    """`faked(0)` sets the clock and gives the variables for a process that keeps to it, within a second."""
    peer("faketime")
    library = next(Path("/usr/lib").glob(f"*/faketime/{LIBRARY}"), None)
    assert library is not None, LIBRARY
    setting = tmp_path / "clock"

    def to(offset_s: int) -> dict[str, str]:
        fresh = setting.with_name("clock.new")
        fresh.write_text(f"{offset_s:+d}\n")
        fresh.replace(setting)
        return {
            "LD_PRELOAD": str(library),
            "FAKETIME_TIMESTAMP_FILE": str(setting),
            "FAKETIME_CACHE_DURATION": "1",
            "FAKETIME_DONT_FAKE_MONOTONIC": "1",
        }

    return to


def metric(text: str, name: str) -> float:
    """The first sample of a metric."""
    found = re.search(rf"^{name}(?:{{.*}})? (\S+)$", text, re.MULTILINE)
    assert found is not None, name
    return float(found[1])


def uptime_s(snmpget: str, service: Service, credentials: tuple[str, ...]) -> float:
    """sysUpTime, by an authenticated and encrypted request."""
    asked = [snmpget, *credentials, "-r0", "-t3", "-Oqvt", f"127.0.0.1:{service.snmp}", "1.3.6.1.2.1.1.3.0"]
    done = subprocess.run(asked, capture_output=True, text=True, env=environment(), check=False)
    assert done.returncode == 0, done.stderr
    return int(done.stdout) / 100


async def is_set(service: Service, started_at: float) -> None:
    """Wait until the process has seen its clock set: by it, the gateway started then."""

    async def seen() -> float:
        return metric((await service.get("/metrics"))[1], "prostar_gateway_start_time_seconds")

    async with asyncio.timeout(30):
        while abs(await seen() - started_at) > 30.0:  # noqa: ASYNC110 - the process has no event for it
            await asyncio.sleep(0.05)


async def most_asked(unit: Unit) -> bytes:
    """The poll that comes most often, once it is known which that is."""
    await until(lambda: Counter(unit.asked).most_common(1)[0][1] >= 5)
    ((live, _),) = Counter(unit.asked).most_common(1)
    return live


async def test_after_a_suspend_there_is_one_round_of_polls_and_no_burst(service: Service) -> None:
    """The process stands still for a while, as it does when the machine sleeps."""
    service.configure((("shelter-a", "array-1", 1, 11),), "[poll]\nlive_s = 0.2\n", LINE_KEYS)
    program = service.start()
    await service.online()
    unit = service.units["shelter-a"][0]
    live = await most_asked(unit)
    program.process.send_signal(signal.SIGSTOP)
    await asyncio.sleep(3.0)  # fifteen rounds that are missed
    loop = asyncio.get_running_loop()
    before, woken = unit.asked.count(live), loop.time()
    program.process.send_signal(signal.SIGCONT)
    async with client(service.modbus) as asker:
        assert (await asker.read(11))[:2] == b"\x03\x04"
        await asyncio.sleep(1.0)
    assert 0 < unit.asked.count(live) - before < 3 + 5 * (loop.time() - woken)
    await service.online()
    log = program.log()
    for trouble in ("line_down", "device_offline", "Traceback"):
        assert trouble not in log
    assert await service.end() == 0


@pytest.mark.peer
async def test_nobody_notices(
    service: Service, faked: Callable[[int], dict[str, str]], peer: Callable[[str], str]
) -> None:
    snmpget = peer("snmpget")
    table, noc = user("noc", service.folder, "correct-horse-1")
    service.configure((("shelter-a", "array-1", 1, 11),), f"[poll]\nlive_s = 0.2\n{table}", LINE_KEYS)
    started_at = time.time()
    program = Program([sys.executable, "-c", GATEWAY, "run", "-c", str(service.config)], **faked(START))
    service.programs.append(program)
    await service.online()
    await is_set(service, started_at + START)
    unit = service.units["shelter-a"][0]
    loop = asyncio.get_running_loop()
    began, up_s = loop.time(), await asyncio.to_thread(uptime_s, snmpget, service, noc)
    live = await most_asked(unit)
    asked, counting = unit.asked.count(live), loop.time()
    await until(lambda: unit.asked.count(live) >= asked + 5)
    polls_per_s = 5 / (loop.time() - counting)
    stepping, asked = loop.time(), unit.asked.count(live)
    async with reading(service.modbus, 11) as reader:
        for step in STEPS:
            faked(step)
            await is_set(service, started_at + step)
            text = (await service.get("/metrics"))[1]
            assert 0 <= metric(text, "morningstar_last_reply_age_seconds") < 60.0
            assert metric(text, "morningstar_up") == 1
            shown_s = await asyncio.to_thread(uptime_s, snmpget, service, noc)
            assert abs(shown_s - up_s - (loop.time() - began)) < 60.0
    assert reader.replies == {b"\x03\x04"}
    assert reader.worst_s < 10.0
    # No burst of polls that were missed in the time that never was, and no pause until a time that is long over.
    assert 0.1 < (unit.asked.count(live) - asked) / (loop.time() - stepping) / polls_per_s < 5.0
    log = program.log()
    for trouble in ("device_stale", "device_offline", "line_down", "Traceback", "time_window"):
        assert trouble not in log
    assert re.search(r"^time=1972-", log, re.MULTILINE)
    assert await service.end() == 0
