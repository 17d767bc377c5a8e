"""The EMC-1 view: numbers, exact forms, three ways to ask, the same rights, and what its users make of it."""

from __future__ import annotations

import re
from collections.abc import AsyncIterator, Awaitable, Callable
from dataclasses import replace
from ipaddress import ip_network
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pysnmp.proto.api import v2c

from gateway.core.site import Device, Site
from gateway.core.snapshot import Block, DeviceState, Snapshot
from gateway.devices.model import DeviceMap, Emc1Form, Space
from gateway.devices.schema import load_map, models
from gateway.faces.snmp.agent import SnmpAgent
from gateway.faces.snmp.emc1 import bit_octets, context_of, emc1_tree, float_text
from gateway.faces.snmp.settings import Community, Emc1Device, Oid, User, View
from tests.faces.snmp import zabbix
from tests.faces.snmp.poller import AUTH_PHRASE, LOOPBACK, PRIV_PHRASE, Poller, a_user, credentials
from tests.faces.snmp.stub_site import NOW, StubClock, online, run_tool, stale
from tests.faces.snmp.test_responder import LOCAL, Reply, request

ROOT: Oid = (1, 3, 6, 1, 4, 1, 33333, 5)
SYSTEM: Oid = (1, 3, 6, 1, 2, 1, 1)
DOTTED = ".".join(map(str, ROOT))
NOT_WRITABLE = 17

# Number → register, as an EMC-1 has them.
FLOATS = dict(zip(range(30, 42), (0x12, 0x13, 0x14, 0x10, 0x16, 0x15, 0x17, 0x08, *range(0x1A, 0x1E)), strict=True)) | {
    42: 0x1E,
    43: 0x1F,
    44: 0x20,
    47: 0x23,
    48: 0x24,
    51: 0x2A,
    52: 0x2B,
    55: 0x30,
    62: 0x3C,
    63: 0x3D,
    64: 0x3E,
    65: 0x3F,
    66: 0x41,
    67: 0x42,
    68: 0x43,
    69: 0x44,
    73: 0x4C,
    74: 0x4F,
    75: 0x50,
}
INTEGERS = {45: 0x21, 53: 0x2E, 60: 0x3A, 61: 0x3B}
UNSIGNED = {49: 0x26, 50: 0x28, 56: 0x32, 57: 0x34, 58: 0x36}
BITS = {46: 0x22, 54: 0x2F, 59: 0x38, 70: 0x45, 71: 0x46, 72: 0x47}
FORMS = {
    Emc1Form.FLOAT: FLOATS,
    Emc1Form.INTEGER: INTEGERS,
    Emc1Form.UNSIGNED: UNSIGNED,
    Emc1Form.BITS: BITS,
}

Read = Callable[..., Any]
Make = Callable[..., SnmpAgent]


@pytest.fixture
def emc1(make_agent: Make, clock: StubClock) -> SnmpAgent:
    """11 has a port of its own, 21 only name@21 and its context, 12 neither; two communities, two users."""
    agent = make_agent(
        emc1=(Emc1Device(11, (("127.0.0.1", 0),)), Emc1Device(21)),
        communities=(
            Community("public", LOOPBACK),
            Community("narrow", LOOPBACK, View(((1, 3, 6, 1, 2, 1, 1),))),
            Community("elsewhere", (ip_network("192.0.2.0/24"),)),
        ),
        users=(a_user("noc"), User(credentials("narrow"), LOOPBACK, View((ROOT,), ((*ROOT, 30),)))),
    )
    agent.prepare()
    clock.now = NOW + 12.5
    return agent


@pytest.fixture
def read(emc1: SnmpAgent, clock: StubClock) -> Read:
    """`read(30)`: what 11's view answers at root.30.0, None when there is no such instance."""

    def cell(number: int, unit: int = 11) -> object:
        slot = next(slot for slot in emc1._responder._contexts[context_of(unit)] if slot.oid == (*ROOT, number, 0))
        assert (slot.varbind(clock.now) is None) == (slot.object.get(slot.row, clock.now) is None)
        return slot.object.get(slot.row, clock.now)

    return cell


def shown(device: Device, **values: float) -> None:
    snapshot = device.snapshot
    device.snapshot = replace(snapshot, version=snapshot.version + 1, values={**snapshot.values, **values})


def test_the_numbers_are_those_of_the_vendor(device_map: DeviceMap) -> None:
    assert device_map.emc1_root == ROOT
    for form, numbers in FORMS.items():
        found = {
            point.emc1.number: point.address
            for point in device_map.points
            if point.emc1 is not None and point.emc1.form is form
        }
        assert found == numbers
        assert all(point.space is Space.REGISTERS for point in device_map.points if point.emc1 is not None)


@pytest.mark.parametrize(
    ("value", "text"),
    [(53.9375, b"53.9375"), (34.0, b"34.0"), (0.0, b"0.0"), (-0.03125, b"-0.0312"), (12.5, b"12.5"), (7, b"7.0")],
)
def test_a_float_has_up_to_four_decimals_and_at_least_one(value: float, text: bytes) -> None:
    assert float_text(value) == text


@given(st.floats(-65504, 65504, width=16))
def test_every_float_reads_back_to_four_decimals(value: float) -> None:
    text = float_text(value).decode()
    assert re.fullmatch(r"-?\d+\.(\d|\d{1,3}[1-9])", text)
    assert float(text) == pytest.approx(value, abs=5.1e-5)


@given(st.integers(0, 2**32 - 1))
def test_bit_0_is_the_first_of_four_octets(value: int) -> None:
    octets = bit_octets(value)
    assert octets is not None
    assert len(octets) == 4
    assert {bit for bit in range(32) if value >> bit & 1} == {
        bit for bit in range(32) if octets[bit // 8] >> (7 - bit % 8) & 1
    }


def test_a_bit_field_that_does_not_fit_is_none() -> None:
    assert bit_octets(-1) is bit_octets(2**32) is None


def test_every_value_has_its_form(read: Read, site: Site) -> None:
    shown(
        site.by_unit[11],
        battery_voltage=53.9375,
        rts_temperature=-12.0,
        charge_energy_total=123.4,
        charge_state=5,
        dip_switches=0b10000101,
        charge_total=4567.8,
        hourmeter=98765,
        array_faults=0b1,
        alarms=1 << 28 | 1 << 3,
    )
    assert [read(number) for number in (30, 41, 52, 45, 60, 50, 58, 46, 59)] == [
        b"53.9375",
        b"-12.0",
        b"123.4",
        5,
        0b10000101,
        45678,
        98765,
        b"\x80\x00\x00\x00",
        b"\x10\x00\x00\x08",
    ]


def test_who_it_is(read: Read, emc1: SnmpAgent, site: Site, clock: StubClock) -> None:
    assert [read(number) for number in (1, 2, 3)] == [b"PS-MPPT-40M", b"16250001", b"v01.02.13"]
    values = {
        slot.oid[len(SYSTEM)]: slot.object.get(slot.row, clock.now)
        for slot in emc1._responder._contexts[b"11"]
        if slot.oid[: len(SYSTEM)] == SYSTEM
    }
    assert values[1].startswith(b"prostar-gateway ")  # type: ignore[union-attr]
    assert b"array-1" in values[1]  # type: ignore[operator]
    assert values[2] == ROOT
    assert values[3] == 1250
    assert (values[4], values[5], values[6]) == (b"noc@example.org", b"array-1", b"ridge")


def test_a_device_that_was_never_heard_still_tells_what_it_should_be(site: Site, device_map: DeviceMap) -> None:
    device = site.by_unit[21]
    device.snapshot = Snapshot()
    tree = emc1_tree(any_gateway(site), device)
    shown_now = {slot.oid: slot.object.get(slot.row, NOW) for slot in tree if slot.varbind(NOW) is not None}
    assert {oid[len(ROOT)] for oid in shown_now if oid[: len(ROOT)] == ROOT} == {1, 2, 3}
    assert shown_now[*ROOT, 1, 0] == b"Morningstar ProStar MPPT"
    assert shown_now[*ROOT, 2, 0] == shown_now[*ROOT, 3, 0] == b""


def any_gateway(site: Site) -> Any:
    from gateway.core.stats import ModbusServerStats
    from gateway.faces.snmp.settings import SnmpSettings

    agent = SnmpAgent(SnmpSettings(listen=()), site, StubClock(), ModbusServerStats())
    return next(iter(agent.tree)).row


@pytest.mark.parametrize("state", [DeviceState.STALE, DeviceState.OFFLINE, DeviceState.UNKNOWN])
def test_of_a_device_that_is_not_online_only_its_name_is_left(
    emc1: SnmpAgent, site: Site, device_map: DeviceMap, clock: StubClock, state: DeviceState
) -> None:
    device = site.by_unit[11]
    device.snapshot = replace(stale(device.snapshot), state=state)
    numbers = {
        slot.oid[len(ROOT)]
        for slot in emc1._responder._contexts[b"11"]
        if slot.oid[: len(ROOT)] == ROOT and slot.varbind(clock.now) is not None
    }
    assert numbers == {1, 2, 3}
    reply = Reply(emc1._responder.answer(request(v2c.GetRequestPDU, (*ROOT, 30, 0)), LOCAL, clock.now, b"11"))
    assert reply.kinds() == ["NoSuchInstance"]
    device.snapshot = online(device_map, 11)
    assert next(slot for slot in emc1._responder._contexts[b"11"] if slot.oid == (*ROOT, 30, 0)).varbind(clock.now)


def test_a_sensor_that_is_not_fitted_is_nan_and_its_bits_are_not_zero(read: Read, site: Site) -> None:
    device = site.by_unit[11]
    values = {
        name: value for name, value in device.snapshot.values.items() if name not in {"rts_temperature", "alarms"}
    }
    block = Block(Space.REGISTERS, 0, 82, bytes(164), NOW)
    device.snapshot = replace(device.snapshot, version=7, values=values, blocks=(block,))
    assert read(41) == b"nan"
    assert read(59) is None  # nobody knows is not "no alarms"
    device.snapshot = replace(device.snapshot, version=8, blocks=())
    assert read(41) is None


def test_what_does_not_fit_is_no_value(read: Read, site: Site) -> None:
    shown(site.by_unit[11], charge_total=5e8, array_faults=2**32, hourmeter=-1)
    assert [read(number) for number in (50, 46, 58)] == [None, None, None]


def test_a_model_that_the_converter_does_not_know_has_no_view(site: Site, device_map: DeviceMap) -> None:
    device = Device("other", 3, 3, replace(device_map, emc1_root=None))
    with pytest.raises(ValueError, match="prostar-mppt has no objects"):
        emc1_tree(any_gateway(site), device)


@pytest.mark.parametrize("model", models())
def test_every_model_with_a_root_makes_a_tree(site: Site, model: str) -> None:
    device_map = load_map(model)
    if device_map.emc1_root is None:
        assert all(point.emc1 is None for point in device_map.points)
        return
    device = Device("one", 3, 3, device_map)
    words = tuple(Block(each.space, each.first, each.count, bytes(2 * each.count), NOW) for each in device_map.extents)
    device.snapshot = replace(online(device_map, 3), blocks=words)
    found = [slot for slot in emc1_tree(any_gateway(site), device) if slot.varbind(NOW) is not None]
    assert len(found) == 7 + 3 + sum(point.emc1 is not None for point in device_map.points)


# Who may see it


def ask(agent: SnmpAgent, clock: StubClock, community: bytes, context: bytes = b"", kind: type | None = None) -> Any:
    """The reply to a question for battery voltage and system name, None when nothing comes back."""
    wanted = request(kind or v2c.GetRequestPDU, (*ROOT, 30, 0), (*SYSTEM, 5, 0), community=community)
    data = agent.answer(wanted, LOCAL, context)
    return None if data is None else Reply(data)


def texts(reply: Reply) -> list[bytes]:
    return [bytes(value.getComponent().getComponent()) for value in reply.values]


def test_a_port_a_name_and_a_context_lead_to_the_same(emc1: SnmpAgent, clock: StubClock) -> None:
    by_port = ask(emc1, clock, b"public", b"11")
    by_name = ask(emc1, clock, b"public@11")
    assert texts(by_port) == texts(by_name) == [b"12.125", b"array-1"]
    assert texts(ask(emc1, clock, b"public@21"))[1] == b"array-3"
    noc = Poller(lambda data: emc1.answer(data, LOCAL), credentials("noc"), context=b"21")
    noc.sign_in()
    found = noc.ask(v2c.GetRequestPDU, (*ROOT, 30, 0), (*SYSTEM, 5, 0))
    assert found is not None
    assert b"array-3" in found.pdu


def test_the_port_is_the_context_of_who_names_none(emc1: SnmpAgent) -> None:
    noc = Poller(lambda data: emc1.answer(data, LOCAL, b"11"), credentials("noc"))
    noc.sign_in()
    names = []
    for context in (b"", b"21", b"", b"11"):
        noc.context = context
        found = noc.ask(v2c.GetRequestPDU, (*SYSTEM, 5, 0))
        assert found is not None
        names.append(found.pdu.rpartition(b"array-")[2][:1])
    assert names == [b"1", b"3", b"1", b"1"]


def test_without_opting_in_there_is_nothing(emc1: SnmpAgent, agent: SnmpAgent, clock: StubClock) -> None:
    assert ask(emc1, clock, b"public").kinds()[0] == "NoSuchObject"  # the default context has it not
    assert ask(emc1, clock, b"public@12") is None
    assert ask(agent, clock, b"public@11") is None
    noc = Poller(lambda data: emc1.answer(data, LOCAL), credentials("noc"), context=b"12")
    noc.sign_in()
    found = noc.ask(v2c.GetRequestPDU, (*ROOT, 30, 0))
    assert found is None or found.kind == "ReportPDU"


@pytest.mark.parametrize("community", [b"elsewhere", b"private", b"", b"@11", b"11", b"public@011", b"public@11@11"])
@pytest.mark.parametrize("context", [b"", b"11"])
def test_a_wrong_community_sees_nothing_anywhere(
    emc1: SnmpAgent, clock: StubClock, community: bytes, context: bytes
) -> None:
    for name in (community, community + b"@11", community + b"@21"):
        assert ask(emc1, clock, name, context) is None
    assert emc1.counters.responses == 0
    assert emc1.counters.bad_community_names == 3


def test_a_stranger_is_refused_before_anything_is_looked_at(emc1: SnmpAgent) -> None:
    assert emc1.answer(b"\xff" * 100, "198.51.100.1", b"11") is None
    assert (emc1.counters.refused_sources, emc1.counters.parse_errors) == (1, 0)


def walk(asked: Callable[[Oid], Reply | None]) -> list[Oid]:
    found: list[Oid] = []
    at: Oid = (0, 0)
    while (reply := asked(at)) is not None and reply.kinds() != ["EndOfMibView"]:
        at = reply.names[0]
        assert not found or at > found[-1]
        found.append(at)
    return found


@pytest.mark.parametrize(("community", "context"), [(b"public", b"11"), (b"public@11", b""), (b"narrow", b"11")])
def test_a_walk_shows_what_the_view_allows_and_nothing_of_the_gateway(
    emc1: SnmpAgent, clock: StubClock, community: bytes, context: bytes
) -> None:
    def asked(at: Oid) -> Reply | None:
        data = emc1.answer(request(v2c.GetNextRequestPDU, at, community=community), LOCAL, context)
        return None if data is None else Reply(data)

    found = walk(asked)
    assert {oid[: len(SYSTEM)] for oid in found if oid[4] == 2} == {SYSTEM}
    private = {oid[: len(ROOT)] for oid in found if oid[4] == 4}
    assert private == (set() if community == b"narrow" else {ROOT})
    assert len(found) == (7 if community == b"narrow" else 7 + 3 + sum(map(len, FORMS.values())))


@pytest.mark.parametrize(("name", "count"), [("noc", 7 + 3 + 46), ("narrow", 3 + 45)])
def test_a_walk_by_context_shows_what_the_users_view_allows(emc1: SnmpAgent, name: str, count: int) -> None:
    user = Poller(lambda data: emc1.answer(data, LOCAL), credentials(name), context=b"11")
    user.sign_in()
    found: list[Oid] = []
    while True:
        read = user.ask(v2c.GetNextRequestPDU, found[-1] if found else (0, 0))
        assert read is not None
        assert read.kind == "ResponsePDU"
        if found and read.names[0] == found[-1]:
            break
        found.append(read.names[0])
    assert len(found) == count
    assert (*ROOT, 30, 0) not in found or name == "noc"


@pytest.mark.parametrize("subtree", [(1, 3, 6, 1, 6, 3), (1, 3, 6, 1, 4, 1, 20408), (1, 3, 6, 1, 4, 1, 32473)])
def test_nothing_else_is_in_the_view(emc1: SnmpAgent, clock: StubClock, subtree: Oid) -> None:
    for community, context in ((b"public", b"11"), (b"public@21", b""), (b"narrow@11", b"")):
        data = emc1.answer(request(v2c.GetNextRequestPDU, subtree, community=community), LOCAL, context)
        assert data is not None
        reply = Reply(data)
        assert reply.kinds() == ["EndOfMibView"] or reply.names[0][: len(subtree)] != subtree


@pytest.mark.parametrize(("community", "context"), [(b"public", b"11"), (b"public@11", b""), (b"narrow", b"11")])
def test_set_is_refused(emc1: SnmpAgent, clock: StubClock, community: bytes, context: bytes) -> None:
    for oid in ((*ROOT, 30, 0), (*SYSTEM, 4, 0), (*ROOT, 999, 0)):
        wanted = request(v2c.SetRequestPDU, oid, community=community, value=v2c.OctetString(b"mine"))
        data = emc1.answer(wanted, LOCAL, context)
        assert data is not None
        assert Reply(data).status == NOT_WRITABLE
    assert emc1.counters.bad_community_uses == 3


def test_set_by_a_user_is_refused(emc1: SnmpAgent) -> None:
    for context in (b"", b"11"):
        noc = Poller(lambda data: emc1.answer(data, LOCAL, b"11"), credentials("noc"), context=context)
        noc.sign_in()
        read = noc.ask(v2c.SetRequestPDU, (*ROOT, 30, 0))
        assert read is not None
        assert read.status == NOT_WRITABLE


def test_the_allowance_of_a_source_counts_on_every_port(make_agent: Make, clock: StubClock) -> None:
    agent = make_agent(emc1=(Emc1Device(11),), requests_per_s=1.0)
    answered = [ask(agent, clock, b"public", b"11" if turn % 2 else b"") is not None for turn in range(30)]
    assert sum(answered) == 10
    assert agent.counters.rate_limited == 20


# What its users make of it

Tool = Callable[..., Awaitable[str]]


@pytest.fixture
async def tool(emc1: SnmpAgent, peer: Callable[[str], str]) -> AsyncIterator[Tool]:
    """`await tool("snmpget", oid)` at 11's own port; a net-snmp without any MIB."""
    for listener in emc1.listeners:
        await listener.start()
    try:
        bound = [listener.bound for listener in emc1.listeners]

        async def run(name: str, *arguments: str, port: int = 1, options: tuple[str, ...] = ("-c", "public")) -> str:
            address = bound[port]
            assert address is not None
            fixed = ("-M", "/nonexistent", "-m", "", "-t", "2", "-r", "0", "-On")
            known = options if "-v" in options else ("-v", "2c", *options)
            _, output = await run_tool(peer(name), *fixed, *known, f"udp:127.0.0.1:{address[1]}", *arguments)
            return output

        yield run
    finally:
        for listener in emc1.listeners:
            await listener.stop()


@pytest.mark.peer
async def test_net_snmp_reads_it_in_every_way(tool: Tool) -> None:
    wanted = f".{DOTTED}.30.0"
    v3 = ("-v", "3", "-u", "noc", "-l", "authPriv", "-a", "SHA-256", "-A", AUTH_PHRASE, "-x", "AES", "-X", PRIV_PHRASE)
    by_port = await tool("snmpget", wanted)
    assert re.fullmatch(rf'{re.escape(wanted)} = STRING: "12\.125"\n', by_port)
    assert await tool("snmpget", wanted, port=0, options=("-c", "public@11")) == by_port
    assert await tool("snmpget", wanted, port=0, options=(*v3, "-n", "11")) == by_port
    assert await tool("snmpget", wanted, options=v3) == by_port
    assert "No Such Object" in await tool("snmpget", wanted, port=0)


@pytest.mark.peer
async def test_a_walk_ends_and_every_value_has_the_type_of_the_converter(tool: Tool) -> None:
    output = await tool("snmpbulkwalk", "-Cc", f".{DOTTED}")
    found = dict(re.findall(rf"^\.{re.escape(DOTTED)}\.(\d+)\.0 = (\S+):", output, re.MULTILINE))
    types = dict.fromkeys((1, 2, 3, *FLOATS), "STRING")
    types |= dict.fromkeys(INTEGERS, "INTEGER") | dict.fromkeys(UNSIGNED, "Gauge32")
    for number in BITS:  # octets that are all printable would be shown as text
        assert found[str(number)] in {"Hex-STRING", "STRING"}
    assert {int(number): kind for number, kind in found.items() if int(number) not in BITS} == types


@pytest.mark.peer
async def test_librenms_detects_it(tool: Tool) -> None:
    """Its rule: sysObjectID begins with the vendor's number and subModel (number 1) contains "MPPT"."""
    told = await tool("snmpget", ".1.3.6.1.2.1.1.2.0", f".{DOTTED}.1.0", ".1.3.6.1.2.1.1.1.0")
    [object_id] = re.findall(r"= OID: (\S+)", told)
    assert object_id.startswith(".1.3.6.1.4.1.33333.")
    assert re.search(rf'^\.{re.escape(DOTTED)}\.1\.0 = STRING: ".*MPPT.*"$', told, re.MULTILINE)
    assert "prostar-gateway" in told.splitlines()[2], "the description says what it is"


def item(emc1: SnmpAgent, number: int) -> str:
    """What Zabbix gets for an item."""
    data = emc1.answer(request(v2c.GetRequestPDU, (*ROOT, number, 0)), LOCAL, b"11")
    assert data is not None
    reply = Reply(data)
    assert reply.kinds() != ["NoSuchInstance"]
    value = reply.values[0].getComponent().getComponent()
    return zabbix.octets(bytes(value)) if hasattr(value, "asOctets") else str(int(value))


def test_the_zabbix_template_reads_values_states_and_amp_hours(emc1: SnmpAgent, site: Site) -> None:
    values = site.by_unit[11].snapshot.values
    for number, name in ((30, "battery_voltage"), (33, "charge_current"), (38, "heatsink_temperature")):
        assert zabbix.number(item(emc1, number)) == pytest.approx(values[name], abs=1e-4)
    assert float(item(emc1, 49)) * zabbix.AH_MULTIPLIER == pytest.approx(values["charge_resettable"])
    assert int(item(emc1, 45)) == values["charge_state"]


@pytest.mark.parametrize(("number", "point"), [(46, "array_faults"), (54, "load_faults"), (59, "alarms")])
def test_the_zabbix_template_finds_every_fault(
    emc1: SnmpAgent, site: Site, device_map: DeviceMap, number: int, point: str
) -> None:
    described = device_map.point(point)
    assert described.bits is not None
    bits = {bit.number: bit.name for bit in device_map.bit_tables[described.bits]}
    names = [bits.get(position, "unused") for position in range(max(bits) + 1)]
    for position, name in bits.items():
        shown(site.by_unit[11], **{point: 1 << position})
        assert zabbix.flags(item(emc1, number), names) == [name]
    shown(site.by_unit[11], **{point: 0})
    assert zabbix.flags(item(emc1, number), names) == []
    shown(site.by_unit[11], **{point: sum(1 << position for position in bits)})
    assert zabbix.flags(item(emc1, number), names) == [bits[position] for position in sorted(bits)]


def test_two_octets_would_show_no_fault() -> None:
    """Why a word is sent in four octets."""
    assert zabbix.flags("80 00 00 00", ["overcurrent"]) == ["overcurrent"]
    assert zabbix.flags("80 00", ["overcurrent"]) == []


def test_an_absent_sensor_is_unsupported_in_zabbix_not_zero() -> None:
    assert zabbix.number("nan") is None
    assert zabbix.number("-12.0") == -12.0
