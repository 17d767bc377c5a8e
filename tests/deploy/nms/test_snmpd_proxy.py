"""A real snmpd that keeps the host's port hands the gateway on, by the delivered lines."""

from __future__ import annotations

import asyncio
import re
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path

import pytest

from tests.deploy.nms.conftest import COMMUNITY, Plant
from tests.faces.snmp.stub_site import run_tool

pytestmark = pytest.mark.peer

Ask = Callable[..., Awaitable[str]]
HOST = "the-hosts-own"


@pytest.fixture
async def host(
    plant: Plant,
    peer: Callable[[str], str],
    delivered: Callable[[str], str],
    tmp_path: Path,
    free_udp_port: Callable[[], int],
) -> AsyncIterator[Ask]:
    """`await host("snmpwalk", oid)`: a question to the host's agent, by its own community."""
    port = free_udp_port()
    lines = delivered("snmpd.conf").replace("CHANGE-ME", COMMUNITY).replace("127.0.0.1:1161", f"127.0.0.1:{plant.port}")
    (tmp_path / "snmpd.conf").write_text(f"rocommunity {HOST} 127.0.0.1\nsysContact host@example.org\n{lines}")
    process = await asyncio.create_subprocess_exec(
        *(peer("snmpd"), "-f", "-Lo", "-C", "-c", str(tmp_path / "snmpd.conf"), "-p", str(tmp_path / "pid")),
        f"udp:127.0.0.1:{port}",
        env={"SNMP_PERSISTENT_DIR": str(tmp_path), "SNMPCONFPATH": str(tmp_path), "MIBS": ""},
        stdout=asyncio.subprocess.DEVNULL,
        stderr=asyncio.subprocess.DEVNULL,
    )

    async def ask(tool: str, *arguments: str, community: str = HOST, timeout_s: float = 1.0) -> str:
        patience = ("-t", str(timeout_s), "-r", "3" if timeout_s == 1.0 else "0")
        options = ("-v", "2c", "-c", community, "-m", "", "-On", *patience)
        return (await run_tool(peer(tool), *options, f"udp:127.0.0.1:{port}", *arguments))[1]

    try:
        yield ask
    finally:
        process.terminate()
        await process.wait()


async def test_the_hosts_agent_answers_for_the_gateway(host: Ask, plant: Plant) -> None:
    contact = await host("snmpget", ".1.3.6.1.2.1.1.4.0")
    assert "host@example.org" in contact  # the host is still itself
    live = "1.3.6.1.4.1.32473.1.1.2.1.4.1.9.11"
    value = plant.online[0].snapshot.values["battery_voltage"]
    assert await host("snmpget", f".{live}") == f".{live} = INTEGER: {round(value * 1000)}\n"
    sensor = await host("snmpget", ".1.3.6.1.2.1.99.1.1.1.4.11009", ".1.3.6.1.2.1.47.1.1.1.1.7.11000")
    assert f"INTEGER: {round(value * 1000)}" in sensor
    assert 'STRING: "array-1"' in sensor


async def test_a_walk_through_the_host_is_the_gateways_own(host: Ask, plant: Plant) -> None:
    root = "1.3.6.1.4.1.32473.1.1.2.1"
    direct = {slot.oid for slot in plant.agent.tree if slot.varbind(1012.5) is not None}
    for table in (4, 5, 6, 7):
        output = await host("snmpbulkwalk", f".{root}.{table}")
        walked = {tuple(map(int, oid.split("."))) for oid in re.findall(r"^\.([\d.]+) = ", output, re.MULTILINE)}
        base = tuple(map(int, f"{root}.{table}".split(".")))
        assert walked == {oid for oid in direct if oid[: len(base)] == base}
        assert len(walked) > 5


async def test_a_stranger_to_the_host_reads_nothing_of_the_gateway(host: Ask) -> None:
    assert "host@example.org" in await host("snmpget", ".1.3.6.1.2.1.1.4.0")
    site = ".1.3.6.1.4.1.32473.1.1.2.1.1.1.0"
    assert "Timeout" in await host("snmpget", site, community=COMMUNITY, timeout_s=0.3)


async def test_set_through_the_host_is_refused(host: Ask) -> None:
    output = await host("snmpset", ".1.3.6.1.4.1.32473.1.1.2.1.1.1.0", "s", "mine")
    assert re.search("noAccess|notWritable|authorizationError", output), output
