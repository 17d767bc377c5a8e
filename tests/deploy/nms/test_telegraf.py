"""The delivered Telegraf configuration. Debian has no Telegraf, so it is held to what Telegraf's documentation says of
its SNMP input: the keys that it knows, tables of columns that share an index, and `float(N)`, which divides by 10^N.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Awaitable, Callable
from typing import Any

import pytest

from gateway.devices.schema import load_map
from gateway.generate.telegraf import UNITS, field_name
from tests.deploy.nms.conftest import COMMUNITY, NMS, SILENT, Plant
from tests.faces.snmp.stub_site import run_tool

PATH = NMS / "telegraf" / "prostar-gateway.conf"

Walk = Callable[[str], Awaitable[dict[str, str]]]


@pytest.fixture
def plugin() -> dict[str, Any]:
    config = tomllib.loads(PATH.read_text(encoding="utf-8"))
    assert set(config) == {"inputs"}
    [found] = config["inputs"]["snmp"]
    assert isinstance(found, dict)
    return found


@pytest.fixture
def walk(plant: Plant, peer: Callable[[str], str]) -> Walk:
    async def walked(oid: str) -> dict[str, str]:
        """Index → value of a column."""
        options = ("-v", "2c", "-c", COMMUNITY, "-m", "", "-OQnUt", f"udp:127.0.0.1:{plant.port}")
        _, output = await run_tool(peer("snmpwalk"), *options, f".{oid}")
        return dict(re.findall(rf'^\.{re.escape(oid)}\.([\d.]+) = "?(.*?)"?$', output, re.MULTILINE))

    return walked


def test_every_key_is_one_that_telegraf_knows(plugin: dict[str, Any]) -> None:
    known = {"agents", "interval", "timeout", "retries", "name", "version", "community", "field", "table"}
    assert set(plugin) <= known
    assert plugin["version"] == 2
    for table in plugin["table"]:
        assert set(table) == {"name", "inherit_tags", "index_as_tag", "field"}
    fields = [*plugin["field"], *(field for table in plugin["table"] for field in table["field"])]
    for field in fields:
        assert {"name", "oid"} <= set(field) <= {"name", "oid", "is_tag", "conversion"}
        assert re.fullmatch(r"1(\.\d+)+", field["oid"])
        assert re.fullmatch(r"float\([1-6]\)", field.get("conversion", "float(1)"))
    for table in plugin["table"]:
        names = [field["name"] for field in table["field"]]
        assert len(names) == len(set(names))


def test_the_comments_are_keys_for_snmpv3(plugin: dict[str, Any]) -> None:
    text = PATH.read_text(encoding="utf-8")
    commented = dict(re.findall(r"^  # (\w+) = \"?(\w[\w-]*)\"?$", text, re.MULTILINE))
    assert set(commented) == {
        "version",
        "sec_name",
        "sec_level",
        "auth_protocol",
        "auth_password",
        "priv_protocol",
        "priv_password",
    }
    assert (commented["sec_level"], commented["auth_protocol"], commented["priv_protocol"]) == (
        "authPriv",
        "SHA256",
        "AES",
    )
    assert "public" not in text


@pytest.mark.peer
async def test_every_value_of_a_controller_comes_in_its_unit(plugin: dict[str, Any], walk: Walk, plant: Plant) -> None:
    [controllers] = [table for table in plugin["table"] if table["name"] == "prostar_controller"]
    columns: dict[str, dict[str, str]] = {}
    for field in controllers["field"]:
        places = int(re.sub(r"\D", "", field.get("conversion", "0")))
        columns[field["name"]] = {
            index: value if field.get("is_tag") or not places else str(int(value) / 10**places)
            for index, value in (await walk(field["oid"])).items()
        }
    assert columns["device"] == {str(device.unit_id): device.name for device in plant.site.devices}
    assert columns["state"][str(SILENT)] == "1"
    for device in plant.online:
        for point in load_map(device.map.model).points:
            if point.mib is None or point.bits is not None or point.group.value not in {"live", "energy", "today"}:
                continue
            value = float(columns[field_name(point)][str(device.unit_id)])
            assert value == pytest.approx(device.snapshot.values[point.name], abs=0.5 / point.mib.scale + 1e-9)
            assert point.unit == "" or field_name(point).endswith(f"_{UNITS[point.unit]}")
        assert float(columns["reply_age_s"][str(device.unit_id)]) == 12.5


@pytest.mark.peer
async def test_every_condition_comes_with_its_name(plugin: dict[str, Any], walk: Walk, plant: Plant) -> None:
    [conditions] = [table for table in plugin["table"] if table["name"] == "prostar_condition"]
    columns = {field["name"]: await walk(field["oid"]) for field in conditions["field"]}
    assert columns["condition"]["11.401"] == "offline"
    assert columns["state"]["11.401"] == "1"
    assert columns["condition"].keys() == columns["state"].keys() == columns["severity"].keys()
    assert len(columns["state"]) > 60


@pytest.mark.peer
async def test_scalars_and_tags(plugin: dict[str, Any], walk: Walk, plant: Plant) -> None:
    found = {field["name"]: await walk(field["oid"].removesuffix(".0")) for field in plugin["field"]}
    assert found["site"] == {"0": "ridge-07"}
    assert found["devices_online"] == {"0": str(len(plant.online))}
    assert [table["inherit_tags"] for table in plugin["table"]] == [["site"], ["site"]]
