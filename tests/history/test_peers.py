"""Prometheus' own programs on exported days: promtool makes blocks, a real server answers from them."""

from __future__ import annotations

import asyncio
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest
from aiohttp import ClientError, ClientSession

from gateway.core.daylog import LogFormat, Selection
from gateway.history.dates import HOUR_S
from gateway.history.export import export
from gateway.history.reader import HistoryReader
from tests.history.blocks import WALL


def make_blocks(promtool: str, history: Path, folder: Path) -> str:
    text = folder / "days.om"
    with HistoryReader(history) as reader, text.open("w", encoding="utf-8") as file:
        file.writelines(export(reader, LogFormat.OPENMETRICS, Selection(), "ridge-07"))
    done = subprocess.run(
        [promtool, "tsdb", "create-blocks-from", "openmetrics", text, folder / "data"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    (folder / "prometheus.yml").write_text("global: {}\n", encoding="utf-8")
    return done.stdout


async def ask(session: ClientSession, url: str, query: str, at: float) -> list[tuple[dict[str, str], float]]:
    async with session.get(f"{url}/api/v1/query", params={"query": query, "time": str(at)}) as reply:
        found = (await reply.json())["data"]["result"]
    return [(series["metric"], float(series["value"][1])) for series in found]


@pytest.mark.peer
async def test_a_real_prometheus_answers_over_a_back_filled_day(
    peer: Callable[[str], str], free_tcp_port: Callable[[], int], tmp_path: Path, history: Path
) -> None:
    said = await asyncio.to_thread(make_blocks, peer("promtool"), history, tmp_path)
    assert "BLOCK ULID" in said
    url = f"http://127.0.0.1:{free_tcp_port()}"
    process = await asyncio.create_subprocess_exec(
        peer("prometheus"),
        f"--config.file={tmp_path / 'prometheus.yml'}",
        f"--storage.tsdb.path={tmp_path / 'data'}",
        "--storage.tsdb.retention.time=100y",
        f"--web.listen-address={url.removeprefix('http://')}",
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        async with ClientSession() as session, asyncio.timeout(60):
            while True:
                try:
                    async with session.get(f"{url}/-/ready") as reply:
                        if reply.status == 200:
                            break
                except ClientError:
                    pass
                await asyncio.sleep(0.05)
            written = WALL - 5 * HOUR_S
            query = 'last_over_time(morningstar_charge_daily_amperehours{device="array-1"}[1d])'
            [(labels, value)] = await ask(session, url, query, WALL)
            assert value == 60.0
            assert labels["controller"] == "shelter-a/array-1"
            [(_, at)] = await ask(session, url, "timestamp(morningstar_charge_daily_amperehours)", written)
            assert at == pytest.approx(written, abs=0.001)
            [(_, days)] = await ask(session, url, "count_over_time(morningstar_hourmeter_daily_seconds[200d])", WALL)
            assert days == 100
            alarms = await ask(session, url, "sum_over_time(morningstar_alarms_daily[200d])", WALL)
            assert sorted(value for _, value in alarms) == [1, 1, 2]
            assert await ask(session, url, 'morningstar_charge_daily_amperehours{unit_id="12"}', WALL) == []
    finally:
        process.terminate()
        await process.wait()
