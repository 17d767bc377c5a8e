"""net-snmp's own tools against the agent, reading it through the generated MIB."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace

import pytest

from gateway.core.site import Site
from gateway.faces.snmp.agent import SnmpAgent
from gateway.faces.snmp.objects import Syntax
from gateway.faces.snmp.settings import Oid
from tests.faces.snmp.stub_site import Ask, StubClock, online, run_tool, stale

pytestmark = pytest.mark.peer

ROOT = "1.3.6.1.4.1.32473.1"

NET_SNMP_TYPES = {
    Syntax.INTEGER32: "INTEGER",
    Syntax.ENUMERATION: "INTEGER",
    Syntax.UNSIGNED32: "Gauge32",  # the same tag (RFC 2578 §7.1.11); net-snmp prints its other name
    Syntax.GAUGE32: "Gauge32",
    Syntax.COUNTER32: "Counter32",
    Syntax.TIME_TICKS: "Timeticks",
    Syntax.TIME_STAMP: "Timeticks",
    Syntax.TEXT: "STRING",
    Syntax.BITS: "BITS",
    Syntax.OBJECT_IDENTIFIER: "OID",
}


def cells(output: str) -> dict[str, str]:
    """`name.index` → `TYPE: value` of a walk."""
    lines = [line for line in output.splitlines() if " = " in line and "No more variables" not in line]
    pairs = (line.split(" = ", 1) for line in lines)
    return {name.rpartition("::")[2]: shown for name, shown in pairs}


async def test_get_shows_values_with_names_and_units(ask: Ask) -> None:
    code, output = await ask(
        "snmpget",
        "PROSTAR-GATEWAY-MIB::pgwBatteryVoltage.11",
        "PROSTAR-GATEWAY-MIB::pgwDeviceState.12",
        "PROSTAR-GATEWAY-MIB::pgwLineName.2",
        "PROSTAR-GATEWAY-MIB::pgwModbusExceptions.0",
        ".1.3.6.1.2.1.1.2.0",
    )
    assert code == 0
    assert output.splitlines() == [
        "PROSTAR-GATEWAY-MIB::pgwBatteryVoltage.11 = INTEGER: 12125 millivolts",
        "PROSTAR-GATEWAY-MIB::pgwDeviceState.12 = INTEGER: unknown(1)",
        "PROSTAR-GATEWAY-MIB::pgwLineName.2 = STRING: Hütte",
        "PROSTAR-GATEWAY-MIB::pgwModbusExceptions.0 = Counter32: 7",
        "SNMPv2-SMI::mib-2.1.2.0 = OID: PROSTAR-GATEWAY-REG-MIB::pgwGatewayProduct",
    ]


async def test_every_answered_oid_is_in_the_mib_with_its_type(ask: Ask, agent: SnmpAgent, clock: StubClock) -> None:
    code, output = await ask("snmpbulkwalk", "-Cc", ROOT)
    assert code == 0
    answered = cells(output)
    expected = {}
    at = len(agent.layout.objects)
    in_tables = {table.number for table in agent.layout.tables}
    for slot in agent.tree:
        if slot.oid[:7] == agent.layout.root[:7] and slot.varbind(clock.now) is not None:
            index = ".".join(map(str, slot.oid[at + (3 if slot.oid[at] in in_tables else 2) :]))
            expected[f"{slot.object.name}.{index}"] = NET_SNMP_TYPES[slot.object.syntax]
    tails = {"pgwLog": ("11.24", "11.48", "21.24"), "pgwClient": ("1",)}
    for table in (each for each in agent.layout.tables if each.name in tails):
        for column in table.columns:
            expected |= {f"{column.name}.{row}": NET_SNMP_TYPES[column.syntax] for row in tails[table.name]}
    assert set(answered) == set(expected)
    for name, shown in answered.items():
        assert shown.split(":", 1)[0] == expected[name], name
    # Labels, units and hints are those of the MIB; net-snmp says "Wrong Type" when tag and MIB disagree.
    assert "Wrong Type" not in output
    assert not re.search(r"BITS: [0-9A-F ]+$", output, re.MULTILINE), "a bit without a name"


async def test_every_leaf_of_the_mib_is_answered(
    ask: Ask, peer: Callable[[str], str], mib_path: str, site: Site
) -> None:
    site.by_unit[12].snapshot = online(site.by_unit[12].map, 12)  # every model is online
    _, tree = await run_tool(peer("snmptranslate"), "-M", mib_path, "-m", "PROSTAR-GATEWAY-MIB", "-Tp", f".{ROOT}")
    leaves = set(re.findall(r"-R-- \w+\s+(\w+)\(", tree))
    _, output = await ask("snmpwalk", ROOT)
    answered = cells(output)
    assert len(leaves) > 150
    assert {name.partition(".")[0] for name in answered} == leaves


@pytest.mark.parametrize("table", ["pgwLine", "pgwDevice", "pgwLive", "pgwEnergy", "pgwToday", "pgwSettings"])
async def test_snmptable_shows_every_table(ask: Ask, agent: SnmpAgent, table: str) -> None:
    code, output = await ask("snmptable", "-Ci", "-Cf", "|", f"PROSTAR-GATEWAY-MIB::{table}Table")
    assert code == 0
    rows = [line.split("|") for line in output.splitlines() if "|" in line]
    described = next(each for each in agent.layout.tables if each.name == table)
    assert rows[0] == ["index", *(column.name for column in described.columns)]
    indexes = {"pgwLine": ["1", "2"], "pgwDevice": ["11", "12", "21"]}.get(table, ["11", "21"])
    assert [row[0] for row in rows[1:]] == indexes


async def test_every_condition_has_a_row_whatever_the_device_does(ask: Ask, site: Site) -> None:
    device = site.by_unit[11]
    device.snapshot = replace(device.snapshot, values={**device.snapshot.values, "array_faults": 1 << 3, "alarms": 0})
    _, output = await ask("snmpwalk", "PROSTAR-GATEWAY-MIB::pgwConditionTable")
    rows = cells(output)
    assert {name.split(".")[1] for name in rows} == {"0", "11", "12", "21"}
    assert len([name for name in rows if name.startswith("pgwConditionState.12.")]) > 40
    assert rows["pgwConditionName.11.103"] == "STRING: array_fault_battery_hvd"
    assert rows["pgwConditionText.11.103"] == "STRING: battery high-voltage disconnect"
    assert rows["pgwConditionSeverity.11.103"] == "INTEGER: critical(3)"
    assert rows["pgwConditionState.11.103"] == "INTEGER: raised(2)"
    assert rows["pgwConditionCount.11.103"] == "Counter32: 1"
    assert rows["pgwConditionState.11.328"] == "INTEGER: clear(1)"
    assert rows["pgwConditionState.12.503"] == "INTEGER: unknown(3)"
    assert rows["pgwConditionName.0.1002"] == "STRING: line_down"
    _, output = await ask(
        "snmpget", *(f"PROSTAR-GATEWAY-MIB::pgwDevice{each}.11" for each in ("Conditions", "Severity"))
    )
    assert [line.split(": ")[-1] for line in output.splitlines()][1] == "critical(3)"


async def test_walks_by_getnext_and_by_getbulk_agree(ask: Ask) -> None:
    _, whole = await ask("snmpwalk", "-Cc", "1.3")
    static = [line for line in whole.splitlines() if "mib-2.11." not in line]  # the walk counts itself there
    for repetitions in ("1", "10", "25", "50"):
        code, output = await ask("snmpbulkwalk", f"-Cr{repetitions}", "1.3")
        assert code == 0
        assert [line for line in output.splitlines() if "mib-2.11." not in line] == static
    assert "OID not increasing" not in whole


async def test_getnext_and_getbulk(ask: Ask) -> None:
    code, output = await ask("snmpgetnext", "PROSTAR-GATEWAY-MIB::pgwBatteryVoltage.11")
    assert (code, output.split(" = ")[0]) == (0, "PROSTAR-GATEWAY-MIB::pgwBatteryVoltage.21")
    code, output = await ask("snmpbulkget", "-Cn1", "-Cr3", "1.3.6.1.2.1.1", "PROSTAR-GATEWAY-MIB::pgwDeviceState")
    assert code == 0
    assert [line.split(" = ")[0].rpartition("::")[2] for line in output.splitlines()] == [
        "mib-2.1.1.0",
        "pgwDeviceState.11",
        "pgwDeviceState.12",
        "pgwDeviceState.21",
    ]


async def test_live_values_of_a_stale_device_vanish(ask: Ask, site: Site) -> None:
    _, before = await ask("snmpwalk", "PROSTAR-GATEWAY-MIB::pgwLiveTable")
    site.by_unit[11].snapshot = stale(site.by_unit[11].snapshot)

    _, after = await ask("snmpwalk", "PROSTAR-GATEWAY-MIB::pgwLiveTable")
    _, state = await ask(
        "snmpget", "PROSTAR-GATEWAY-MIB::pgwDeviceState.11", "PROSTAR-GATEWAY-MIB::pgwBatteryVoltage.11"
    )

    assert {name.rpartition(".")[2] for name in cells(before)} == {"11", "21"}
    assert {name.rpartition(".")[2] for name in cells(after)} == {"21"}
    assert "stale(3)" in state
    assert "No Such Instance" in state


@pytest.mark.parametrize("subtree", ["1.3.6.1.6.3", "1.3.6.1.4.1.20408", "1.3.6.1.6"])
async def test_the_engines_own_tree_is_not_there(ask: Ask, subtree: str) -> None:
    _, output = await ask("snmpwalk", subtree)
    # The successor lies outside of the subtree, so net-snmp asks for the node itself and gets nothing.
    assert "No Such Object" in output or "No more variables" in output
    assert len(output.splitlines()) == 1


@pytest.mark.parametrize(
    "options",
    [
        ("-c", "private"),
        ("-c", "elsewhere"),  # a known community, but not from here
        ("-v", "1", "-c", "public"),
        ("-v", "3", "-l", "noAuthNoPriv", "-u", "public"),
    ],
)
@pytest.mark.parametrize("arguments", [("snmpget", "1.3.6.1.2.1.1.1.0"), ("snmpset", "1.3.6.1.2.1.1.4.0", "s", "me")])
async def test_anything_but_the_right_community_gets_no_answer(
    ask: Ask, agent: SnmpAgent, arguments: tuple[str, ...], options: tuple[str, ...]
) -> None:
    code, output = await ask(*arguments, options=(*options, "-t", "0.3"))
    assert code != 0
    assert "Timeout" in output
    assert agent.counters.responses == 0


async def test_set_is_not_writable(ask: Ask, agent: SnmpAgent, clock: StubClock) -> None:
    contact: Oid = (1, 3, 6, 1, 2, 1, 1, 4, 0)
    before = agent.tree.get(contact, clock.now)
    code, output = await ask("snmpset", "1.3.6.1.2.1.1.4.0", "s", "me")
    assert code != 0
    assert "notWritable" in output
    assert agent.tree.get(contact, clock.now) == before
