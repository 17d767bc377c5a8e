"""Debian's own snmp_exporter scrapes an agent by the delivered file: names, units and labels are those of /metrics.

The file is the one that the page names for the version that is installed: Debian 12 has 0.21, Debian 13 has 0.28.
"""

from __future__ import annotations

import asyncio
import contextlib
import re
import subprocess
import urllib.error
import urllib.request
from collections.abc import AsyncIterator, Awaitable, Callable
from dataclasses import dataclass, replace
from pathlib import Path

import pytest

from gateway.core.site import Device
from gateway.devices.model import Kind, Point
from gateway.devices.schema import load_map, models
from gateway.generate.snmp_exporter import metric_of
from tests.deploy.nms.conftest import COMMUNITY, SILENT, Plant
from tests.faces.snmp.poller import AUTH_PHRASE, PRIV_PHRASE
from tests.faces.snmp.stub_site import stale

MODULES = ("prostar_gateway", "prostar_gateway_settings")
OLD, NEW = "snmp_exporter/snmp-debian12.yml", "snmp_exporter/snmp.yml"
CREDENTIALS_APART = (0, 23)
"""From this version on credentials stand beside the modules, and a query names them."""

Series = dict[tuple[str, frozenset[tuple[str, str]]], float]
Scrape = Callable[[str], Awaitable[Series]]


def series(text: str) -> Series:
    """Name and labels → value of what the exporter writes."""
    found: Series = {}
    for line in text.splitlines():
        match = re.fullmatch(r"(\w+)(?:\{(.*)\})? (\S+)", line)
        if match and not line.startswith("#"):
            key = (match[1], frozenset(re.findall(r'(\w+)="((?:[^"\\]|\\.)*)"', match[2] or "")))
            assert key not in found, line
            found[key] = float(match[3])
    return found


def of(device: Device, **more: str) -> frozenset[tuple[str, str]]:
    """The labels of a device."""
    labels = {"unit_id": str(device.unit_id), "device": device.name, "model": device.map.model}
    return frozenset((labels | {"line": device.line.name} | more).items())


async def get(url: str) -> str:
    def read() -> str:
        with urllib.request.urlopen(url, timeout=60) as reply:
            text: str = reply.read().decode()
            return text

    return await asyncio.to_thread(read)


@dataclass(frozen=True)
class Installed:
    """The exporter of this machine, and the delivered file that is for it."""

    program: str
    file: str
    query: str

    @property
    def query_v3(self) -> str:
        """As `query`, for the SNMPv3 user."""
        return self.query.replace("_v2c", "_v3")


@pytest.fixture
def installed(peer: Callable[[str], str]) -> Installed:
    program = peer("prometheus-snmp-exporter")
    told = subprocess.run([program, "--version"], capture_output=True, text=True, check=True)
    version = re.match(r"snmp_exporter, version (\d+)\.(\d+)", told.stdout + told.stderr)
    assert version is not None, told
    if (int(version[1]), int(version[2])) < CREDENTIALS_APART:
        return Installed(program, OLD, "")
    return Installed(program, NEW, "&auth=prostar_v2c")


@pytest.fixture
async def exporter(
    installed: Installed, delivered: Callable[[str], str], tmp_path: Path, free_tcp_port: Callable[[], int]
) -> AsyncIterator[Callable[[str], Awaitable[str]]]:
    """`await exporter(config)` starts one and gives its URL; the default is what is delivered, with the community."""
    running: list[asyncio.subprocess.Process] = []

    async def start(config: str = "") -> str:
        path = tmp_path / "snmp.yml"
        path.write_text(config or delivered(installed.file).replace("CHANGE-ME", COMMUNITY), encoding="utf-8")
        port = free_tcp_port()
        running.append(
            await asyncio.create_subprocess_exec(
                installed.program,
                f"--config.file={path}",
                f"--web.listen-address=127.0.0.1:{port}",
                stderr=asyncio.subprocess.DEVNULL,
            )
        )
        for _ in range(200):
            with contextlib.suppress(OSError, urllib.error.URLError):
                await get(f"http://127.0.0.1:{port}/")
                break
            await asyncio.sleep(0.05)
        return f"http://127.0.0.1:{port}"

    yield start
    for process in running:
        process.terminate()
        await process.wait()


@pytest.fixture
async def scrape(plant: Plant, installed: Installed, exporter: Callable[..., Awaitable[str]]) -> Scrape:
    url = await exporter()
    return lambda module: scraped(url, module + installed.query, plant)


async def scraped(url: str, module: str, plant: Plant) -> Series:
    return series(await get(f"{url}/snmp?target=127.0.0.1:{plant.port}&module={module}"))


def shown_points(device: Device, *, settings: bool) -> list[Point]:
    return [
        point
        for point in device.map.points
        if point.mib is not None and point.metric is not None and (point.group.value == "settings") is settings
    ]


@pytest.mark.peer
async def test_every_point_has_its_name_its_unit_and_its_value(scrape: Scrape, plant: Plant) -> None:
    for module in MODULES:
        found = await scrape(module)
        for device in plant.online:
            for point in shown_points(device, settings=module == MODULES[1]):
                assert point.mib is not None
                name, power = metric_of(point)
                if point.kind is Kind.TEXT:
                    assert found[name, of(device, **{name: device.snapshot.texts[point.name]})] == 1
                    continue
                value = device.snapshot.values[point.name]
                if point.enumeration is not None:
                    names = {each.number: each.name for each in device.map.enumerations[point.enumeration]}
                    assert found[name, of(device, **{name: names[int(value)]})] == 1
                elif point.bits is not None:
                    for bit in device.map.bit_tables[point.bits]:
                        is_set = int(value) >> bit.number & 1
                        assert found[name, of(device, **{name: bit.name})] == is_set, (point.name, bit.name)
                else:
                    factor = point.metric_scale if name == point.metric else 1.0
                    step = 10.0**power if power is not None else 1.0
                    assert found[name, of(device)] == pytest.approx(value * factor, abs=step / 2 + 1e-9), name


@pytest.mark.peer
async def test_no_metric_is_lost_and_none_is_made_up(scrape: Scrape, plant: Plant) -> None:
    names = {name for module in MODULES for name, _ in await scrape(module)}
    points = {
        metric_of(point)[0]
        for model in models()
        for point in load_map(model).points
        if point.metric is not None and point.mib is not None
    }
    of_points = {name for name in names if name.startswith("morningstar_")}
    assert of_points == points
    with_metric = {point.name for model in models() for point in load_map(model).points if point.metric is not None}
    columns = {
        column.name
        for table in plant.agent.layout.tables
        for column in table.columns
        if column.point not in with_metric
    }
    scalars = {each.name for group in plant.agent.layout.groups for each in group.objects}
    assert {name for name in names if name.startswith("pgw")} <= columns | scalars
    assert {"pgwDeviceState", "pgwLineState", "pgwDevicesOnline", "pgwConditionState", "pgwModbusConnections"} <= names


@pytest.mark.peer
async def test_states_conditions_and_lines_are_labelled_by_name(scrape: Scrape, plant: Plant) -> None:
    found = await scrape(MODULES[0])
    silent = plant.site.by_unit[SILENT]
    assert found["pgwDeviceState", of(silent, pgwDeviceState="unknown")] == 1
    assert found["pgwDeviceState", of(plant.online[0], pgwDeviceState="online")] == 1
    assert found["pgwLineState", frozenset({("line_index", "2"), ("line", "Hütte"), ("pgwLineState", "down")})] == 1
    labels = {"unit_id": "11", "device": "array-1", "condition_code": "401", "condition": "offline"}
    assert found["pgwConditionState", frozenset(labels.items())] == 1
    assert found["pgwConditionSeverity", frozenset(labels.items())] == 3
    assert found["pgwModbusConnections", frozenset()] == 5
    assert not [key for key in found if key[0].startswith("morningstar_") and ("unit_id", str(SILENT)) in key[1]]


@pytest.mark.peer
async def test_a_device_that_goes_away_leaves_no_value(scrape: Scrape, plant: Plant) -> None:
    device = plant.online[0]
    assert ("morningstar_battery_voltage_volts", of(device)) in await scrape(MODULES[0])
    device.snapshot = stale(device.snapshot)
    found = await scrape(MODULES[0])
    assert not [key for key in found if key[0].startswith("morningstar_") and ("unit_id", "11") in key[1]]
    assert found["pgwDeviceState", of(device, pgwDeviceState="stale")] == 1


@pytest.mark.peer
@pytest.mark.parametrize("value", [0.0, 0.004, -0.004, 0.04, -0.04, 0.4, 1.0, -1.5, 12.345, -12.345, 250.0])
async def test_any_number_is_shifted_right(scrape: Scrape, plant: Plant, value: float) -> None:
    device = plant.online[0]
    values = {**device.snapshot.values, "battery_voltage": value}
    device.snapshot = replace(device.snapshot, version=9, values=values)
    found = await scrape(MODULES[0])
    assert found["morningstar_battery_voltage_volts", of(device)] == pytest.approx(value, abs=1e-12)


@pytest.mark.peer
async def test_it_scrapes_with_snmpv3_too(
    plant: Plant, installed: Installed, exporter: Callable[..., Awaitable[str]], delivered: Callable[[str], str]
) -> None:
    """The credentials of the newer form; an exporter before it has them in its module, written the same."""
    [auth] = re.findall(r"^  prostar_v3:\n((?:    .*\n)+)", delivered(NEW), re.MULTILINE)
    assert "version: 3" in auth
    secured = auth.replace('password: "CHANGE-ME"', f'password: "{AUTH_PHRASE}"', 1)
    secured = secured.replace('"CHANGE-ME"', f'"{PRIV_PHRASE}"')
    config = delivered(NEW).replace(auth, secured)
    if installed.file == OLD:
        old = '  version: 2\n  auth:\n    community: "CHANGE-ME"\n'
        assert delivered(OLD).count(old) == len(MODULES)
        in_module = "  version: 3\n  auth:\n" + secured.replace("    version: 3\n", "")
        config = delivered(OLD).replace(old, in_module)
    url = await exporter(config)
    found = await scraped(url, MODULES[0] + installed.query_v3, plant)
    assert ("morningstar_battery_voltage_volts", of(plant.online[0])) in found


def test_both_files_hold_the_same_modules(delivered: Callable[[str], str]) -> None:
    """The newer form, which Debian 12's exporter cannot read, differs in where the credentials stand."""
    old = re.sub(r'^  version: 2\n  auth:\n    community: "CHANGE-ME"\n', "", delivered(OLD), flags=re.MULTILINE)
    old_body = old.partition("prostar_gateway:\n")[2]
    new_body = re.sub(r"^  ", "", delivered(NEW).partition("modules:\n")[2].partition("\n")[2], flags=re.MULTILINE)
    assert old_body == new_body
    auths = delivered(NEW).partition("auths:\n")[2].partition("modules:\n")[0]
    assert re.findall(r"^  (\w+):", auths, re.MULTILINE) == ["prostar_v2c", "prostar_v3"]
    assert {"MD5", "DES", "SHA"} & set(re.findall(r'"(\w+)"', auths)) == set()
