"""The four pages over a real connection."""

from __future__ import annotations

import asyncio
import contextlib
import gzip
from collections.abc import Callable

import pytest
from aiohttp import ClientSession
from prometheus_client.metrics_core import Metric
from prometheus_client.openmetrics import parser as openmetrics
from prometheus_client.parser import text_string_to_metric_families as parse_plain

from gateway.core.site import LineState, Site
from gateway.core.snapshot import Snapshot
from gateway.devices.schema import load_map

from .conftest import Gateway, ManualClock, UnreadableLine, make_device, online

OPENMETRICS = "application/openmetrics-text; version=1.0.0"


def parse_openmetrics(text: str) -> list[Metric]:
    """Parse strictly; ValueError on anything that OpenMetrics does not allow."""
    return list(openmetrics.text_string_to_metric_families(text))  # type: ignore[no-untyped-call]  # as upstream left it


async def test_plain_text_is_what_a_client_without_wishes_gets(gateway: Gateway) -> None:
    async with ClientSession() as session, session.get(f"{gateway.url}/metrics") as reply:
        assert reply.status == 200
        assert reply.headers["Content-Type"] == "text/plain; version=0.0.4; charset=utf-8"
        families = {family.name: family for family in parse_plain(await reply.text())}
    [voltage] = families["morningstar_battery_voltage_volts"].samples
    assert voltage.value == 12.5
    assert voltage.labels == {
        "site": "ridge-07",
        "line": "shelter-a",
        "device": "array-1",
        "unit_id": "11",
        "model": "sun-1",
    }


async def test_openmetrics_on_request_has_the_same_samples(gateway: Gateway) -> None:
    async with ClientSession() as session:
        async with session.get(f"{gateway.url}/metrics") as reply:
            plain = list(parse_plain(await reply.text()))
        async with session.get(f"{gateway.url}/metrics", headers={"Accept": OPENMETRICS}) as reply:
            assert reply.headers["Content-Type"].startswith("application/openmetrics-text; version=1.0.0")
            text = await reply.text()
    assert text.endswith("# EOF\n")

    def devices(families: list[Metric]) -> set[tuple[str, tuple[tuple[str, str], ...], float]]:
        return {
            (sample.name, tuple(sorted(sample.labels.items())), sample.value)
            for family in families
            for sample in family.samples
            if sample.name.startswith("morningstar_")
        }

    assert devices(plain) == devices(parse_openmetrics(text))
    assert (
        len(devices(plain)) == 24
    )  # 1 + 1 + 2 + 2 series of values; per device up, 4 states, 3 conditions; one age, one info


async def test_gzip_when_the_client_takes_it(gateway: Gateway) -> None:
    async with ClientSession(auto_decompress=False) as session:
        async with session.get(f"{gateway.url}/metrics", headers={"Accept-Encoding": "gzip"}) as reply:
            assert reply.headers["Content-Encoding"] == "gzip"
            assert b"morningstar_up" in gzip.decompress(await reply.read())
        async with session.get(f"{gateway.url}/metrics", headers={"Accept-Encoding": "identity"}) as reply:
            assert "Content-Encoding" not in reply.headers
            assert b"morningstar_up" in await reply.read()


async def test_a_reply_that_nobody_takes_is_given_up(make_gateway: Callable[..., Gateway], clock: ManualClock) -> None:
    line = UnreadableLine("shelter-a")
    device_map = load_map("prostar-mppt")
    devices = [make_device(f"array-{unit}", unit, line, device_map) for unit in range(1, 200)]
    for device in devices:
        device.snapshot = online(clock.now, values={point.name: 1 for point in device_map.points})
    site = Site.of("ridge-07", [line], devices)
    async with make_gateway(site, send_timeout_s=0.05).running() as gateway:
        bound = gateway.face.listeners[0].bound
        assert bound is not None
        reader, writer = await asyncio.open_connection(*bound, limit=1024)
        writer.write(b"GET /metrics HTTP/1.1\r\nHost: gateway\r\n\r\n")
        async with asyncio.timeout(30):
            while not gateway.face.stats.abandoned:  # noqa: ASYNC110  a counter sets no event
                await asyncio.sleep(0.01)
            with contextlib.suppress(ConnectionError):
                while await reader.read(1 << 20):
                    pass
        assert gateway.face.stats.scrapes == 0
        writer.close()
        async with ClientSession() as session, session.get(f"{gateway.url}/healthz") as reply:
            assert reply.status == 200


async def test_head_is_answered_without_a_body(gateway: Gateway) -> None:
    async with ClientSession() as session:
        for _ in range(2):
            async with session.head(f"{gateway.url}/metrics") as reply:
                assert (reply.status, await reply.read()) == (200, b"")
        async with session.get(f"{gateway.url}/metrics") as reply:
            assert b"morningstar_up" in await reply.read()


async def test_a_dead_controller_is_neither_unhealthy_nor_unready(gateway: Gateway, site: Site) -> None:  # F71
    site.devices[0].snapshot = Snapshot()
    async with ClientSession() as session:
        for path, text in (("/healthz", "ok\n"), ("/readyz", "ready\n")):
            async with session.get(gateway.url + path) as reply:
                assert (reply.status, await reply.text()) == (200, text)


async def test_not_ready_says_why_and_is_healthy_all_the_same(gateway: Gateway) -> None:  # F71
    gateway.not_ready = ["modbus 127.0.0.1:502: Permission denied", "snmp 127.0.0.1:161: Permission denied"]
    async with ClientSession() as session:
        async with session.get(f"{gateway.url}/readyz") as reply:
            assert reply.status == 503
            assert (await reply.text()).splitlines() == ["not ready", *gateway.not_ready]
        async with session.get(f"{gateway.url}/healthz") as reply:
            assert reply.status == 200


async def test_index_shows_lines_and_controllers(gateway: Gateway, site: Site, clock: ManualClock) -> None:
    clock.now += 3.25
    line = site.lines[1]
    assert isinstance(line, UnreadableLine)
    line.state, line.error = LineState.DOWN, "no such file"
    async with ClientSession() as session, session.get(f"{gateway.url}/") as reply:
        assert reply.headers["Content-Type"] == "text/html; charset=utf-8"
        page = await reply.text()
    for text in ("ridge-07", 'href="/metrics"', 'href="/healthz"', 'href="/readyz"', "shelter-a", "down: no such file"):
        assert text in page
    rows = [row for row in page.splitlines() if "array-" in row]
    assert ["online" in rows[0], "3.2 s ago" in rows[0]] == [True, True]
    assert ["unknown" in rows[1], "never" in rows[1]] == [True, True]


async def test_names_from_the_configuration_are_text_on_the_page(
    make_gateway: Callable[..., Gateway],
    site: Site,
) -> None:
    line = site.lines[0]
    assert isinstance(line, UnreadableLine)
    line.name = "<script>alert(1)</script>"
    async with make_gateway().running() as gateway, ClientSession() as session, session.get(gateway.url) as reply:
        page = await reply.text()
    assert "<script>" not in page
    assert "&lt;script&gt;alert(1)&lt;/script&gt;" in page


@pytest.mark.parametrize(
    ("method", "path", "status"), [("POST", "/metrics", 405), ("GET", "/etc", 404), ("HEAD", "/", 200)]
)
async def test_other_requests(gateway: Gateway, method: str, path: str, status: int) -> None:
    async with ClientSession() as session, session.request(method, gateway.url + path) as reply:
        assert reply.status == status


async def test_labels_from_the_configuration_are_escaped(
    make_gateway: Callable[..., Gateway], clock: ManualClock
) -> None:  # F70
    name = 'Berg\\hütte "7"\n日本'
    line = UnreadableLine(name)
    device = make_device(name, 1, line)
    device.snapshot = online(clock.now)
    async with make_gateway(Site.of(name, [line], [device])).running() as gateway, ClientSession() as session:
        async with session.get(f"{gateway.url}/metrics") as reply:
            plain = list(parse_plain(await reply.text()))
        async with session.get(f"{gateway.url}/metrics", headers={"Accept": OPENMETRICS}) as reply:
            strict = parse_openmetrics(await reply.text())
    for families in (plain, strict):
        [up] = [sample for family in families for sample in family.samples if sample.name == "morningstar_up"]
        assert [up.labels[label] for label in ("site", "line", "device")] == [name, name, name]
