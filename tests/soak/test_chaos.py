"""Three minutes of everything at once, on real sockets, ptys and processes; an hour of it by hand (SOAK_S=3600).

Faults of every kind on every line, adapters that are pulled; Modbus clients that come and go, scrapes and SNMP walks.
Nothing wrong is served, everything is answered, everything sent is accounted for, and the gateway holds no more at the
end than at the beginning.
"""

from __future__ import annotations

import asyncio
import os
import re
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import pytest

from gateway.simulator.chaos import Fault, all_at
from tests.soak.process import Held, growth_kib, settled
from tests.soak.site import Client, Site, get, running, walk

SOAK_S = float(os.environ.get("SOAK_S", "180"))
WARM_UP_S = min(30.0, SOAK_S / 4)
SAMPLES = 30
CLIENTS = 8
RATES = {**all_at(0.01), Fault.CLOSE: 0.0005, Fault.UNPLUG: 0.0005}
MOST_GROWTH_KIB = 2048
LEAST_REPLIES = 5 * SOAK_S
"""With data; a dozen a second come once late replies made the lines wait up to 2 s after a failure (quarantine.py)."""


async def look(site: Site, snmpbulkwalk: str, until: float, seen: Counter[str]) -> None:
    """Scrape and walk again and again."""
    while time.monotonic() < until:
        status, text = await get(site.http, "/metrics")
        assert status == 200
        assert text.endswith("\n")
        seen["scrapes"] += 1
        shown = await walk(site, snmpbulkwalk)
        assert "Timeout:" not in shown
        assert "OID not increasing" not in shown
        seen["cells"] += shown.count(" = ")
        seen["walks"] += 1
        await asyncio.sleep(1.0)


async def online(site: Site) -> int:
    """How many controllers are online."""
    text = (await get(site.http, "/metrics"))[1]
    return len(re.findall(r"^morningstar_up\{.*\} 1\.0$", text, re.MULTILINE))


async def sample(pid: int, until: float, samples: list[Held]) -> None:
    """What the gateway holds, after everything that is bounded had time to fill up."""
    await asyncio.sleep(WARM_UP_S)
    step_s = (until - time.monotonic()) / (SAMPLES + 1)
    for _ in range(SAMPLES):
        await asyncio.sleep(step_s)
        samples.append(Held.of(pid))


@pytest.mark.peer
@pytest.mark.long
@pytest.mark.timeout(SOAK_S + 240)
async def test_everything_at_once(
    tmp_path: Path,
    peer: Callable[[str], str],
    free_tcp_port: Callable[[], int],
    free_udp_port: Callable[[], int],
) -> None:
    snmpbulkwalk = peer("snmpbulkwalk")
    site = Site(tmp_path, 85, RATES, (free_tcp_port(), free_udp_port(), free_tcp_port()))
    clients = [Client(site, number) for number in range(CLIENTS)]
    seen: Counter[str] = Counter()
    samples: list[Held] = []
    async with running(site) as gateway:
        await get(site.http, "/metrics")
        await walk(site, snmpbulkwalk)
        pid = gateway.process.pid
        until = time.monotonic() + SOAK_S
        async with asyncio.TaskGroup() as group:
            for client in clients:
                group.create_task(client.work(until))
            group.create_task(look(site, snmpbulkwalk, until, seen))
            group.create_task(sample(pid, until, samples))
        for chaos in site.chaos:
            chaos.stop()
        # Everything comes back when the faults are over: a unit in quarantine is asked once a minute.
        async with asyncio.timeout(90):
            while await online(site) < len(site.units):  # noqa: ASYNC110  # another process has no event for us
                await asyncio.sleep(0.5)
        text = (await get(site.http, "/metrics"))[1]
        after = await asyncio.to_thread(settled, pid, samples[0].handles)
    faults = sum((chaos.counts for chaos in site.chaos), Counter[Fault]())
    codes = sum((client.codes for client in clients), Counter[int]())
    assert [wrong for client in clients for wrong in client.wrong] == []
    assert codes[0] > LEAST_REPLIES
    assert set(faults) >= set(Fault) - {Fault.CLOSE, Fault.UNPLUG}
    assert seen["walks"] >= SOAK_S / 30
    assert seen["scrapes"] >= SOAK_S / 30
    assert_accounted(text)
    assert "task_failed" not in gateway.log()
    assert "Traceback" not in gateway.log()
    assert growth_kib(samples) < MOST_GROWTH_KIB, [each.rss_kib for each in samples]
    busiest = max(each.descriptors for each in samples)
    assert after.descriptors <= busiest
    assert after.threads <= max(each.threads for each in samples)


def total(text: str, metric: str) -> float:
    """The sum over all series of a metric."""
    return sum(float(value) for value in re.findall(rf"^{metric}(?:\{{.*\}})? (\S+)$", text, re.MULTILINE))


def assert_accounted(text: str) -> None:
    """Every transaction ended in one way: sent = ok + each kind of failure, but for what is under way now."""
    sent = total(text, "prostar_gateway_line_requests_total")
    ok = total(text, "prostar_gateway_line_replies_total")
    failed = total(text, "prostar_gateway_line_errors_total")
    assert sent > 100
    assert 0 <= sent - ok - failed <= 2, (sent, ok, failed)
