"""The delivered Zabbix template: of the form that Zabbix 6.0 imports, and what it makes of an agent's answers.

The form is what Zabbix documents of its exports. Discovery, filters, preprocessing and its JavaScript (run by Node) are
done here as Zabbix does them, on answers that net-snmp's tools get; the results are what the controllers show.
"""

from __future__ import annotations

import json
import re
import subprocess
from collections.abc import Awaitable, Callable, Iterator
from dataclasses import dataclass
from typing import Any

import pytest

from gateway.core.conditions import Severity
from gateway.devices.schema import load_map, models
from tests.deploy.nms.conftest import COMMUNITY, NMS, SILENT, Plant
from tests.deploy.nms.yaml_file import loaded
from tests.faces.snmp import zabbix as seen_by_zabbix
from tests.faces.snmp.stub_site import run_tool, stale

pytestmark = pytest.mark.peer

ITEM_KEYS = {
    *("uuid", "name", "type", "snmp_oid", "key", "delay", "units", "description", "value_type", "trends", "valuemap"),
    *("preprocessing", "tags", "triggers", "trigger_prototypes"),
}
RULE_KEYS = {"uuid", "name", "type", "snmp_oid", "key", "delay", "filter", "preprocessing", "item_prototypes"}
TRIGGER_KEYS = {"uuid", "expression", "name", "priority", "manual_close", "recovery_mode", "recovery_expression"}
STEPS = {"CHECK_NOT_SUPPORTED", "MULTIPLIER", "JAVASCRIPT", "CHANGE_PER_SECOND", "DISCARD_UNCHANGED_HEARTBEAT"}
PRIORITIES = {"INFO", "WARNING", "AVERAGE", "HIGH"}

Script = Callable[[str, str], str]
Walk = Callable[[str], Awaitable[dict[str, str]]]


@pytest.fixture(scope="module")
def export() -> Any:
    return loaded(NMS / "zabbix" / "prostar-gateway.yaml")["zabbix_export"]


@pytest.fixture(scope="module")
def template(export: Any) -> Any:
    [found] = export["templates"]
    return found


@pytest.fixture
def script(peer: Callable[[str], str]) -> Script:
    """Run a preprocessing script on a value, as a function body."""

    def run(body: str, value: str) -> str:
        program = f"process.stdout.write(String((function (value) {{\n{body}\n}})({json.dumps(value)})));"
        return subprocess.run([peer("node"), "-e", program], capture_output=True, text=True, check=True).stdout

    return run


@pytest.fixture
def walk(plant: Plant, peer: Callable[[str], str]) -> Walk:
    async def walked(oid: str) -> dict[str, str]:
        """Index → value below an OID, octet strings as Zabbix shows them."""
        options = ("-v", "2c", "-c", COMMUNITY, "-m", "", "-Onxt", f"udp:127.0.0.1:{plant.port}")
        _, output = await run_tool(peer("snmpbulkwalk"), *options, f".{oid}")
        found = {}
        lines = re.sub(r"\n(?!\.)", " ", output.strip())  # long texts go on in the next line
        pattern = rf"^\.{re.escape(oid)}\.([\d.]+) = (?:([\w-]+): )?(.*)$"
        for index, kind, text in re.findall(pattern, lines, re.MULTILINE):
            found[index] = seen_by_zabbix.octets(bytes.fromhex(text)) if kind == "Hex-STRING" else text.strip('"')
        return found

    return walked


def parts(template: Any) -> Iterator[tuple[str, Any]]:
    """Everything that has a uuid, with what it is."""
    yield "template", template
    for valuemap in template["valuemaps"]:
        yield "valuemap", valuemap
    for item in template["items"]:
        yield "item", item
        for trigger in item.get("triggers", []):
            yield "trigger", trigger
    for rule in template["discovery_rules"]:
        yield "rule", rule
        for trigger in rule.get("trigger_prototypes", []):
            yield "trigger", trigger
        for item in rule["item_prototypes"]:
            yield "prototype", item
            for trigger in item.get("trigger_prototypes", []):
                yield "trigger", trigger


def test_it_has_the_form_of_an_export(export: Any, template: Any) -> None:
    assert set(export) == {"version", "groups", "templates"}
    assert export["version"] == "6.0"
    assert [group["name"] for group in export["groups"]] == [group["name"] for group in template["groups"]]
    for kind, part in parts(template):
        keys = set(part)
        if kind in {"item", "prototype"}:
            assert keys <= ITEM_KEYS
            assert part["type"] in {"SNMP_AGENT", "INTERNAL"}
            assert ("snmp_oid" in part) == (part["type"] == "SNMP_AGENT")
        elif kind == "rule":
            assert keys <= RULE_KEYS | {"trigger_prototypes"}
        elif kind == "trigger":
            assert keys <= TRIGGER_KEYS
            assert part["priority"] in PRIORITIES
        for step in part.get("preprocessing", []):
            assert set(step) <= {"type", "parameters", "error_handler"}
            assert step["type"] in STEPS
            assert all(isinstance(parameter, str) for parameter in step["parameters"])


def test_every_uuid_is_a_version_4_and_used_once(export: Any, template: Any) -> None:
    found = [part["uuid"] for _, part in parts(template)] + [group["uuid"] for group in export["groups"]]
    assert len(found) == len(set(found))
    assert all(re.fullmatch(r"[0-9a-f]{12}4[0-9a-f]{3}[89ab][0-9a-f]{15}", uuid) for uuid in found)


def test_keys_and_names_are_used_once_and_everything_named_exists(template: Any) -> None:
    keys = [part["key"] for kind, part in parts(template) if kind in {"item", "prototype", "rule"}]
    assert len(keys) == len(set(keys))
    valuemaps = {valuemap["name"] for valuemap in template["valuemaps"]}
    used = {
        part["valuemap"]["name"]
        for kind, part in parts(template)
        if kind in {"item", "prototype"} and "valuemap" in part
    }
    assert used == valuemaps
    macros = {macro["macro"] for macro in template["macros"]}
    for kind, part in parts(template):
        if kind == "trigger":
            both = part["expression"] + part.get("recovery_expression", "")
            assert set(re.findall(r"/ProStar gateway by SNMP/([\w.-]+(?:\[[^\]]*\])?)", both)) <= set(keys)
            assert set(re.findall(r"\{\$[\w.]+\}", both)) <= macros


def test_every_value_of_every_model_has_an_item(template: Any) -> None:
    prototypes = {part["key"] for kind, part in parts(template) if kind == "prototype"}
    for model in models():
        for point in load_map(model).points:
            if point.mib is not None and point.group.value in {"live", "energy", "today"}:
                assert f"morningstar.{point.name}[{model},{{#SNMPINDEX}}]" in prototypes


@dataclass(frozen=True)
class Row:
    """A row that a rule has found."""

    rule: Any
    macros: dict[str, str]


async def rows(rule: Any, walk: Walk, script: Script) -> list[Row]:
    """What a rule discovers: columns joined by index, its script, its filter."""
    [inside] = re.findall(r"^discovery\[(.*)\]$", rule["snmp_oid"])
    pieces = inside.split(",")
    found: dict[str, dict[str, str]] = {}
    for macro, oid in zip(pieces[::2], pieces[1::2], strict=True):
        for index, value in (await walk(oid)).items():
            found.setdefault(index, {"{#SNMPINDEX}": index})[macro] = value
    text = json.dumps(list(found.values()))
    for step in rule.get("preprocessing", []):
        text = script(step["parameters"][0], text)
    conditions = rule.get("filter", {"conditions": []})["conditions"]
    return [
        Row(rule, row)
        for row in json.loads(text)
        if all(re.search(each["value"], row[each["macro"]]) for each in conditions)
    ]


def rule_of(template: Any, key: str) -> Any:
    return next(rule for rule in template["discovery_rules"] if rule["key"] == key)


async def test_controllers_lines_and_models_are_discovered(
    template: Any, walk: Walk, script: Script, plant: Plant
) -> None:
    devices = {device.name for device in plant.site.devices}
    found = await rows(rule_of(template, "prostar.controllers"), walk, script)
    assert {row.macros["{#NAME}"] for row in found} == devices
    found = await rows(rule_of(template, "prostar.lines"), walk, script)
    assert len(found) == 2
    for model in models():
        found = await rows(rule_of(template, f"prostar.{model}"), walk, script)
        of_model = {device.name for device in plant.site.devices if device.map.model == model}
        assert {row.macros["{#NAME}"] for row in found} == of_model


async def test_every_item_has_the_value_of_its_controller(
    template: Any, walk: Walk, script: Script, plant: Plant
) -> None:
    for device in plant.online:
        rule = rule_of(template, f"prostar.{device.map.model}")
        row = next(row for row in await rows(rule, walk, script) if row.macros["{#NAME}"] == device.name)
        columns: dict[str, dict[str, str]] = {}
        for item in rule["item_prototypes"]:
            column, _, index = item["snmp_oid"].partition(".{#SNMPINDEX}")
            assert index == ""
            base = column.rpartition(".")[0]
            if base not in columns:
                columns[base] = await walk(base)
            point = device.map.point(item["key"].partition("[")[0].removeprefix("morningstar."))
            text = columns[base][f"{column.rpartition('.')[2]}.{row.macros['{#SNMPINDEX}']}"]
            value = device.snapshot.values[point.name]
            kinds = [step["type"] for step in item["preprocessing"]]
            assert kinds[0] == "CHECK_NOT_SUPPORTED"
            if point.bits is not None:
                body = item["preprocessing"][1]["parameters"][0]
                named = {bit.number: bit.name for bit in device.map.bit_tables[point.bits]}
                assert script(body, text) == ", ".join(
                    name for number, name in named.items() if int(value) >> number & 1
                )
                assert item["value_type"] == "TEXT"
                continue
            number = float(text)
            for step in item["preprocessing"]:
                if step["type"] == "MULTIPLIER":
                    number *= float(step["parameters"][0])
            assert point.mib is not None
            half = 0.51 * point.metric_scale / point.mib.scale
            assert number == pytest.approx(value * point.metric_scale, abs=half), point.name
            if point.enumeration is not None:
                [valuemap] = [each for each in template["valuemaps"] if each["name"] == item["valuemap"]["name"]]
                assert text in {mapping["value"] for mapping in valuemap["mappings"]}


@pytest.mark.parametrize(
    ("octets", "names"),
    [
        (b"\x80\x00", "short"),
        (b"\x00\x01", "open"),
        (b"\x00\x00", "none"),
        (b"A@", "bit_1, bit_7, bit_9"),
        (b"\x40\x00", "bit_1"),
    ],
)
def test_bits_are_read_however_zabbix_shows_them(script: Script, octets: bytes, names: str) -> None:
    from gateway.generate.zabbix_parts import bits_script

    body = bits_script({0: "short", 15: "open"}, 2)
    assert script(body, seen_by_zabbix.octets(octets)) == names
    assert script(body, octets.hex(" ").upper() + " \n") == names


async def test_a_silent_controller_has_no_values_and_its_state_says_so(template: Any, walk: Walk, plant: Plant) -> None:
    rule = rule_of(template, f"prostar.{models()[0]}")
    plant.online[0].snapshot = stale(plant.online[0].snapshot)
    for item in rule["item_prototypes"][:5]:
        found = await walk(item["snmp_oid"].removesuffix(".{#SNMPINDEX}"))
        assert not {str(SILENT), "11"} & found.keys()
    state = next(part for kind, part in parts(template) if part.get("key") == "prostar.devicestate[{#SNMPINDEX}]")
    assert (await walk(state["snmp_oid"].removesuffix(".{#SNMPINDEX}")))["11"] == "3"


async def test_every_condition_has_a_trigger_of_its_severity(
    template: Any, walk: Walk, script: Script, plant: Plant
) -> None:
    named: dict[str, str] = {}
    for severity, priority in ((Severity.INFO, "INFO"), (Severity.WARNING, "WARNING"), (Severity.CRITICAL, "HIGH")):
        rule = rule_of(template, f"prostar.conditions.{severity.name.lower()}")
        [item] = rule["item_prototypes"]
        [trigger] = item["trigger_prototypes"]
        assert trigger["priority"] == priority
        assert trigger["expression"].endswith("=2")
        for row in await rows(rule, walk, script):
            index = row.macros["{#SNMPINDEX}"]
            assert index == f"{row.macros['{#UNIT}']}.{row.macros['{#CODE}']}"
            named[index] = row.macros["{#CONDITION}"]
    assert plant.agent.tree is not None
    states = await walk("1.3.6.1.4.1.32473.1.1.2.1.8.1.6")
    assert states.keys() == named.keys()
    assert named["11.401"] == "offline"
    for bit in plant.online[0].map.bit_tables["array_faults"]:
        assert named[f"11.{100 + bit.number}"] == f"array_fault_{bit.name}"


async def test_scalars_answer(template: Any, walk: Walk) -> None:
    for item in template["items"]:
        if item["type"] == "SNMP_AGENT":
            assert await walk(item["snmp_oid"].removesuffix(".0")), item["key"]
