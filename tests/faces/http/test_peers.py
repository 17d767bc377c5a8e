"""Prometheus' own programs on our reply: its linter, and a real server that scrapes."""

from __future__ import annotations

import asyncio
import subprocess
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager
from dataclasses import replace
from pathlib import Path

import pytest
from aiohttp import ClientError, ClientSession

from gateway.core.site import Site
from gateway.core.snapshot import DeviceState
from gateway.devices.schema import load_map, models

from .conftest import Gateway, ManualClock, UnreadableLine, make_device, online

MakeGateway = Callable[..., Gateway]

CONFIG = """
global:
  scrape_interval: 500ms
  scrape_timeout: 500ms
scrape_configs:
  - job_name: gateway
    static_configs:
      - targets: ["{target}"]
"""


@pytest.mark.peer
@pytest.mark.parametrize("model", models())
async def test_promtool_has_no_complaint(
    peer: Callable[[str], str],
    clock: ManualClock,
    make_gateway: MakeGateway,
    model: str,
) -> None:  # F70
    device_map = load_map(model)
    line = UnreadableLine('with "quotes", \\ and\nlines')
    line.stats.failed["timeout"] = 1
    device = make_device("日本", 1, line, device_map)
    device.snapshot = replace(online(clock.now), values={point.name: 1 for point in device_map.points})
    gateway = make_gateway(Site.of("ridge-07", [line], [device]))
    gateway.modbus.exceptions[0x0B] = 1
    gateway.snmp["bad_community"] = 1
    async with gateway.running(), ClientSession() as session, session.get(f"{gateway.url}/metrics") as reply:
        text = await reply.read()
    checker = await asyncio.create_subprocess_exec(
        *(peer("promtool"), "check", "metrics"),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    said, complained = await checker.communicate(text)
    assert (checker.returncode, said.decode(), complained.decode()) == (0, "", "")


class Prometheus:
    """A running server; `log` has what it says."""

    def __init__(self, url: str, log: Path) -> None:
        self.url = url
        self.log = log

    async def query(self, session: ClientSession, query: str) -> list[tuple[Mapping[str, str], float]]:
        """Labels and value of each series that a query gives now."""
        async with session.get(f"{self.url}/api/v1/query", params={"query": query}) as reply:
            found = (await reply.json())["data"]["result"]
        return [(series["metric"], float(series["value"][1])) for series in found]

    async def until(self, session: ClientSession, query: str) -> list[tuple[Mapping[str, str], float]]:
        """The answer to a query as soon as there is one."""
        async with asyncio.timeout(30):
            while True:
                try:
                    if found := await self.query(session, query):
                        return found
                except ClientError:  # not listening yet
                    pass
                await asyncio.sleep(0.02)


@asynccontextmanager
async def prometheus(program: str, folder: Path, port: int, target: str) -> AsyncIterator[Prometheus]:
    """Run a Prometheus that scrapes `target` twice a second."""
    config = folder / "prometheus.yml"
    config.write_text(CONFIG.format(target=target), encoding="utf-8")
    log = folder / "log"
    with log.open("wb") as output:
        process = await asyncio.create_subprocess_exec(
            program,
            f"--config.file={config}",
            f"--storage.tsdb.path={folder / 'data'}",
            f"--web.listen-address=127.0.0.1:{port}",
            "--log.level=debug",
            stdout=output,
            stderr=output,
        )
    try:
        yield Prometheus(f"http://127.0.0.1:{port}", log)
    finally:
        if process.returncode is None:
            process.terminate()
        await process.wait()


@pytest.mark.peer
async def test_a_real_prometheus_scrapes_without_a_warning(
    peer: Callable[[str], str],
    free_tcp_port: Callable[[], int],
    tmp_path: Path,
    gateway: Gateway,
) -> None:  # F66, F68
    target = gateway.url.removeprefix("http://")
    async with (
        prometheus(peer("prometheus"), tmp_path, free_tcp_port(), target) as server,
        ClientSession() as session,
    ):
        [(labels, value)] = await server.until(session, "morningstar_battery_voltage_volts")
        assert value == 12.5
        assert labels["device"] == "array-1"
        assert labels["unit_id"] == "11"
        assert [value for _, value in await server.query(session, "up")] == [1]
        assert {labels["device"]: value for labels, value in await server.query(session, "morningstar_up")} == {
            "array-1": 1,
            "array-2": 0,
        }
        [(labels, _)] = await server.query(session, "morningstar_charge_state == 1")
        assert labels["state"] == "bulk"

        # the controller dies: its series end at the next scrape, what says so goes on
        heard_at = gateway.clock.now
        gateway.clock.now += 3600
        gateway.site.devices[0].snapshot = online(heard_at, state=DeviceState.OFFLINE)
        await server.until(
            session, 'morningstar_up{device="array-1"} == 0 unless on() morningstar_battery_voltage_volts'
        )
        [(_, age)] = await server.query(session, "morningstar_last_reply_age_seconds")
        assert age == 3600
        said = server.log.read_text(encoding="utf-8").splitlines()
    assert any("Server is ready" in line for line in said)
    assert [line for line in said if "level=warn" in line or "level=error" in line or "err=" in line] == []
