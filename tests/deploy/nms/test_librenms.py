"""The delivered LibreNMS definitions, by what LibreNMS' documentation says that it does with such files.

Detection compares the beginning of sysObjectID. For each entry of a sensor class, discovery walks the table `oid` with
numbers for enumerations, leaves out the rows that `skip_values` names, fills `{{ $index }}`, `{{ $subindex0 }}` and
columns of the row (or of `additional_oids` by the same index) into `descr`, and keeps `num_oid`, which is then polled.
"""

from __future__ import annotations

import re
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from gateway import __version__
from gateway.devices.schema import load_map, models
from gateway.generate.mib import mib_outputs
from tests.deploy.nms.conftest import COMMUNITY, NMS, SILENT, Plant
from tests.deploy.nms.yaml_file import loaded
from tests.faces.snmp.stub_site import REPOSITORY, run_tool

pytestmark = pytest.mark.peer

NUM_OID = re.compile(r"^(\.\d+)+(\.?\{\{ \$(index|str_index_as_numeric) \}\})?(\.\d+)*$")
STATE_KEYS = {"oid", "value", "num_oid", "descr", "index", "states", "state_name", "group", "skip_values"}
SENSOR_KEYS = {"oid", "value", "num_oid", "descr", "index", "divisor"}

Run = Callable[..., Awaitable[str]]


@pytest.fixture
def detection() -> Any:
    return loaded(NMS / "librenms" / "os_detection" / "prostar-gateway.yaml")


@pytest.fixture
def discovery() -> Any:
    return loaded(NMS / "librenms" / "os_discovery" / "prostar-gateway.yaml")


@pytest.fixture
def run(plant: Plant, peer: Callable[[str], str], tmp_path: Path) -> Run:
    for path, text in mib_outputs(locked="").items():
        (tmp_path / Path(path).name).write_text(text, encoding="utf-8")

    async def tool(name: str, *arguments: str) -> str:
        mibs = ("-M", f"{tmp_path}:{REPOSITORY / 'mibs' / 'base'}", "-m", "PROSTAR-GATEWAY-MIB")
        options = ("-v", "2c", "-c", COMMUNITY, *mibs, f"udp:127.0.0.1:{plant.port}")
        return (await run_tool(peer(name), *options, *arguments))[1]

    return tool


@dataclass(frozen=True)
class Found:
    """A sensor that LibreNMS would make."""

    kind: str
    words: str
    oid: str
    value: float
    states: dict[int, int]


async def rows(run: Run, name: str) -> dict[str, dict[str, str]]:
    found: dict[str, dict[str, str]] = {}
    for line in (await run("snmpbulkwalk", "-OQUse", name)).splitlines():
        match = re.fullmatch(r"(\w+)\.([\d.]+) = (.*)", line)
        assert match is not None, line
        found.setdefault(match[2], {})[match[1]] = match[3].strip('"')
    return found


def filled(words: str, index: str, row: dict[str, str], extra: dict[str, str]) -> str:
    names = {"index": index, **{f"subindex{at}": part for at, part in enumerate(index.split("."))}, **extra, **row}
    return re.sub(r"\{\{ \$(\w+) \}\}", lambda match: names[match[1]], words)


async def discovered(run: Run, discovery: Any) -> list[Found]:
    sensors = dict(discovery["modules"]["sensors"])
    extra: dict[str, dict[str, str]] = {}
    for entry in sensors.pop("additional_oids")["data"]:
        for oid in entry["oid"]:
            for index, row in (await rows(run, oid)).items():
                extra.setdefault(index, {}).update(row)
    found = []
    for kind, described in sensors.items():
        for entry in described["data"]:
            for index, row in (await rows(run, entry["oid"])).items():
                skipped = any(
                    skip["op"] == "!=" and row.get(skip["oid"]) != str(skip["value"])
                    for skip in entry.get("skip_values", [])
                )
                if skipped or entry["value"] not in row:
                    continue
                words = filled(entry["descr"], index, row, extra.get(index, {}))
                states = {state["value"]: state["generic"] for state in entry.get("states", [])}
                value = float(row[entry["value"]]) / entry.get("divisor", 1)
                found.append(Found(kind, words, filled(entry["num_oid"], index, {}, {}), value, states))
    return found


def test_the_keys_are_those_that_librenms_knows(detection: Any, discovery: Any) -> None:
    assert set(detection) == {"os", "text", "type", "mib_dir", "over", "discovery"}
    assert all(set(graph) == {"graph", "text"} for graph in detection["over"])
    assert set(discovery) == {"mib", "modules"}
    assert set(discovery["modules"]) == {"os", "sensors"}
    for kind, described in discovery["modules"]["sensors"].items():
        assert set(described) == {"data"}
        for entry in described["data"]:
            if kind == "additional_oids":
                assert set(entry) == {"oid"}
                continue
            assert set(entry) <= (STATE_KEYS if kind == "state" else SENSOR_KEYS)
            assert NUM_OID.match(entry["num_oid"])
            for state in entry.get("states", []):
                assert set(state) == {"value", "descr", "graph", "generic"}
                assert state["generic"] in range(4)


async def test_the_gateway_is_recognised(run: Run, detection: Any, discovery: Any) -> None:
    told = await run("snmpget", "-OQvn", ".1.3.6.1.2.1.1.2.0")
    [[beginning]] = [entry["sysObjectID"] for entry in detection["discovery"]]
    assert told.strip().startswith(beginning)
    assert detection["os"] == "prostar-gateway"
    version = await run("snmpget", "-OQv", discovery["modules"]["os"]["version"])
    assert version.strip().strip('"') == __version__


async def test_every_sensor_polls_to_what_it_was_discovered_with(run: Run, discovery: Any) -> None:
    found = await discovered(run, discovery)
    assert len({(each.kind, each.words) for each in found}) == len(found), "two sensors of one name"
    assert not [each for each in found if "$" in each.words or "{" in each.words]
    for each in found[:: max(1, len(found) // 20)]:
        polled = await run("snmpget", "-OQeUvn", each.oid)
        assert polled.strip().isdigit(), each
    for each in found:
        if each.kind == "state":
            assert each.value in each.states, each


async def test_states_say_what_is_wrong(run: Run, discovery: Any, plant: Plant) -> None:
    found = {each.words: each for each in await discovered(run, discovery)}
    assert found["array-1 controller"].states[int(found["array-1 controller"].value)] == 0
    assert found["silent controller"].states[int(found["silent controller"].value)] == 3
    device = plant.online[0]
    for point in ("charge_state", "load_state"):
        if point in device.snapshot.values:
            state = found[f"array-1 {point.replace('_', ' ')}"]
            assert state.value == device.snapshot.values[point]
            fault = next(each.number for each in device.map.enumerations[point] if each.name == "fault")
            assert state.states[fault] == 2
    offline = found["unit 11: controller does not answer, or not usably (offline 401)"]
    assert offline.states == {1: 0, 2: 2, 3: 3}
    assert f"unit {SILENT}: battery high-voltage disconnect (array_fault_battery_hvd 103)" in found


async def test_totals_are_in_the_units_of_their_class(run: Run, discovery: Any, plant: Plant) -> None:
    found = {each.words: each for each in await discovered(run, discovery)}
    device = plant.online[0]
    for point in device.map.points:
        kind = {"kWh": "power_consumed", "Ah": "count"}.get(point.unit)
        if point.group.value == "energy" and kind is not None and point.mib is not None:
            words = f"array-1 {point.name.replace('_', ' ')}" + (" (Ah)" if kind == "count" else "")
            assert found[words].kind == kind
            assert found[words].value == pytest.approx(device.snapshot.values[point.name], abs=0.051)


def test_what_entity_sensor_mib_shows_is_not_there_twice(discovery: Any) -> None:
    assert set(discovery["modules"]["sensors"]) == {"additional_oids", "state", "power_consumed", "count"}
    columns = {entry["value"] for entry in discovery["modules"]["sensors"]["state"]["data"]}
    assert columns >= {"pgwDeviceState", "pgwDeviceSeverity", "pgwConditionState", "pgwChargeState"}
    assert {load_map(model).night is not None for model in models()} == {True}
