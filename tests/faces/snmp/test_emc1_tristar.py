"""A TriStar in the EMC-1 view: the vendor's numbers and steps, and what templates make of them.

The words come from a simulated TriStar, or are chosen; what is expected of them is the document's arithmetic.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Mapping
from dataclasses import replace

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pysnmp.proto.api import v2c

from gateway.core.site import Device, Site
from gateway.core.snapshot import Block, DeviceState, Snapshot
from gateway.devices.decode import Decoder
from gateway.devices.model import Emc1Form, Identification, Space
from gateway.devices.schema import load_map
from gateway.faces.snmp.agent import SnmpAgent
from gateway.faces.snmp.settings import Emc1Device, Oid
from gateway.simulator.device import SimulatedController
from gateway.simulator.plant import plants_of
from tests.faces.snmp import zabbix
from tests.faces.snmp.stub_site import NOW, StubClock, run_tool
from tests.faces.snmp.test_responder import LOCAL, Reply, request

ROOT: Oid = (1, 3, 6, 1, 4, 1, 33333, 2)
DOTTED = ".".join(map(str, ROOT))
TRISTAR = load_map("tristar-mppt")
UNIT = 12

# Number → register, as an EMC-1 has them.
VOLTS = {30: 0x1B, 34: 0x3D, 35: 0x3E, 36: 0x18, 37: 0x26, 38: 0x19, 39: 0x1A, 40: 0x28, 41: 0x29, 45: 0x33}
AMPERES = {31: 0x1D, 42: 0x1C, 43: 0x27}
WATTS = {32: 0x3B, 33: 0x3C, 44: 0x3A}
DEGREES = {47: 0x24, 48: 0x25, 49: 0x23}
STATES = {46: 0x32, 54: 0x31, 60: 0x30}
SINGLES = {52: 0x38, 53: 0x39}
PAIRS = {50: 0x34, 51: 0x36, 59: 0x2A}
BITS = {55: 0x2C, 56: 0x49, 57: 0x2E, 58: 0x4B}
VERSIONS = {61: 0x04, 62: 0x1000}
ALL = {**VOLTS, **AMPERES, **WATTS, **DEGREES, **STATES, **SINGLES, **PAIRS, **BITS, **VERSIONS}

VOLT_STEP, AMPERE_STEP, WATT_STEP = 0.0054931640625, 0.00244140625, 0.10986328125
AS_THE_VENDOR = (180, 0, 80, 0)
"""V_PU and I_PU of which the vendor's steps are 2^-15, and their product 2^-17."""

Words = Mapping[tuple[int, int], tuple[int, ...]]
"""By first register and count."""

BLOCKS = ((0x0000, 92), (0x1000, 49))
Make = Callable[..., SnmpAgent]


def snapshot(words: Words) -> Snapshot:
    """What the poller makes of these blocks."""
    values = {}
    blocks = []
    for (first, count), read in words.items():
        data = struct.pack(f">{count}H", *read)
        values.update(Decoder(TRISTAR).decode(Space.REGISTERS, first, data))
        blocks.append(Block(Space.REGISTERS, first, count, data, NOW))
    return Snapshot(
        version=1,
        state=DeviceState.ONLINE,
        values=values,
        read_at=dict.fromkeys(values, NOW),
        blocks=tuple(blocks),
        identification=Identification("Morningstar Corp.", "TS-MPPT-60", "v01.02.13"),
        serial_number="16250001",
    )


def simulated(seed: int = 0) -> Words:
    _, ts_60 = plants_of(TRISTAR)
    made = SimulatedController(TRISTAR, plant=ts_60, start_hour=12.0, seed=seed)
    made.advance(NOW)
    return {each: tuple(made.read(Space.REGISTERS, *each, NOW)) for each in BLOCKS}


def with_words(words: Words, changes: Mapping[int, int]) -> Words:
    """`changes` by register."""
    return {
        (first, count): tuple(changes.get(first + place, word) for place, word in enumerate(read))
        for (first, count), read in words.items()
    }


def signed(word: int) -> int:
    return word - (word >> 15 << 16)


class View:
    """What unit 12's view answers."""

    def __init__(self, agent: SnmpAgent, device: Device, clock: StubClock) -> None:
        self.agent = agent
        self.device = device
        self.clock = clock
        self.words: Words = {}
        self.show(simulated())

    def show(self, words: Words) -> None:
        self.words = words
        self.device.snapshot = replace(snapshot(words), version=self.device.snapshot.version + 1)

    def word(self, register: int) -> int:
        for (first, count), read in self.words.items():
            if first <= register < first + count:
                return read[register - first]
        raise AssertionError(register)

    def pair(self, register: int) -> int:
        return self.word(register) << 16 | self.word(register + 1)

    def get(self, number: int) -> int | bytes | None:
        data = self.agent.answer(request(v2c.GetRequestPDU, (*ROOT, number, 0)), LOCAL, str(UNIT).encode())
        assert data is not None
        reply = Reply(data)
        if reply.kinds() == ["NoSuchInstance"]:
            return None
        value = reply.values[0].getComponent().getComponent()
        return bytes(value) if hasattr(value, "asOctets") else int(value)

    def item(self, number: int) -> str:
        """What Zabbix gets for an item."""
        value = self.get(number)
        assert value is not None
        return zabbix.octets(value) if isinstance(value, bytes) else str(value)


@pytest.fixture
def agent(make_agent: Make, clock: StubClock) -> SnmpAgent:
    made = make_agent(emc1=(Emc1Device(UNIT, (("127.0.0.1", 0),)),))
    made.prepare()
    clock.now = NOW + 12.5
    return made


@pytest.fixture
def view(agent: SnmpAgent, site: Site, clock: StubClock) -> View:
    return View(agent, site.by_unit[UNIT], clock)


def test_the_numbers_are_those_of_the_vendor() -> None:
    """Each of 30 to 62 once, at the vendor's register; 1 to 3 say who it is."""
    assert TRISTAR.emc1_root == ROOT
    found = [(point.emc1.number, point.address) for point in TRISTAR.points if point.emc1 is not None]
    assert sorted(found) == sorted(ALL.items())
    assert sorted(ALL) == list(range(30, 63))
    assert all(point.space is Space.REGISTERS for point in TRISTAR.points if point.emc1 is not None)


def test_every_number_is_the_word_where_the_scaling_is_the_vendors(view: View) -> None:
    view.show(with_words(simulated(), dict(enumerate(AS_THE_VENDOR))))
    expected: dict[int, object] = {
        **{number: signed(view.word(at)) for number, at in {**VOLTS, **AMPERES, **DEGREES}.items()},
        **{number: view.word(at) for number, at in {**WATTS, **STATES, **SINGLES, **VERSIONS}.items()},
        **{number: view.pair(at) for number, at in PAIRS.items()},
    }
    assert {number: view.get(number) for number in expected} == expected
    assert len(set(expected.values())) > 20  # not all the same nothing


@given(
    st.tuples(
        st.integers(-1800, 0x7FFF),  # volts from -10 on, which the map takes for plausible
        st.integers(-4096, 0x7FFF),
        st.integers(0, 0xFFFF),
        st.integers(-40, 80),
        st.integers(0, 16_000_000),
    )
)
@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_any_word_comes_back_or_is_implausible(view: View, words: tuple[int, int, int, int, int]) -> None:
    volt, ampere, watt, degree, pair = words
    changes = dict(enumerate(AS_THE_VENDOR))
    changes |= dict.fromkeys(VOLTS.values(), volt & 0xFFFF) | dict.fromkeys(AMPERES.values(), ampere & 0xFFFF)
    changes |= dict.fromkeys(WATTS.values(), watt) | dict.fromkeys(DEGREES.values(), degree & 0xFFFF)
    changes |= dict.fromkeys(PAIRS.values(), pair >> 16) | {at + 1: pair & 0xFFFF for at in PAIRS.values()}
    view.show(with_words(simulated(), changes))
    shown = view.device.snapshot.values
    for numbers, word in ((VOLTS, volt), (AMPERES, ampere), (WATTS, watt), (DEGREES, degree), (PAIRS, pair)):
        for number in numbers:
            assert view.get(number) == (word if named(number) in shown else None)


def named(number: int) -> str:
    """The point that the vendor has under this number."""
    (found,) = (point.name for point in TRISTAR.points if point.emc1 is not None and point.emc1.number == number)
    return found


@pytest.mark.parametrize("seed", [0, 2])
def test_a_unit_of_another_scaling_is_shown_in_the_vendors_steps(view: View, seed: int) -> None:
    """Its own words, multiplied by a template's fixed numbers, would be volts that nobody measured."""
    view.show(simulated(seed))
    v_pu, i_pu = view.pair(0) / 65536, view.pair(2) / 65536
    assert v_pu != 180
    assert view.get(36) != view.word(0x18)
    for numbers, step, scale in (
        (VOLTS, VOLT_STEP, v_pu / 2**15),
        (AMPERES, AMPERE_STEP, i_pu / 2**15),
        (WATTS, WATT_STEP, v_pu * i_pu / 2**17),
    ):
        for number, at in numbers.items():
            value = view.get(number)
            assert isinstance(value, int)
            word = view.word(at) if numbers is WATTS else signed(view.word(at))
            assert value * step == pytest.approx(word * scale, abs=step / 2 + 1e-9)


def test_without_its_scaling_nothing_that_it_scales_is_there(view: View) -> None:
    view.show(with_words(simulated(), dict.fromkeys(range(4), 0)))
    gone = {number for number in ALL if view.get(number) is None}
    assert gone == {*VOLTS, *AMPERES, *WATTS}


def test_a_version_is_the_word_and_not_its_decimal_digits(view: View) -> None:
    view.show(with_words(simulated(), {0x04: 0x0012, 0x1000: 0x0015}))
    assert (view.get(61), view.get(62)) == (0x12, 0x15)
    view.device.snapshot = replace(view.device.snapshot, version=99, blocks=())
    assert (view.get(61), view.get(62)) == (None, None)


def test_a_sensor_that_is_not_fitted_is_not_there(view: View) -> None:
    view.show(with_words(simulated(), {0x24: 0x0080}))
    assert view.get(47) is None


def test_a_device_that_is_not_online_only_says_who_it_is(view: View) -> None:
    was = view.device.snapshot
    for state in (DeviceState.STALE, DeviceState.OFFLINE, DeviceState.UNKNOWN):
        view.device.snapshot = replace(was, version=view.device.snapshot.version + 1, state=state)
        assert [view.get(number) for number in (1, 2, 3)] == [b"TS-MPPT-60", b"16250001", b"v01.02.13"]
        assert {view.get(number) for number in ALL} == {None}


# What its users make of it


@pytest.mark.parametrize("seed", [None, 0, 2], ids=["vendors_scaling", "seed_0", "seed_2"])
def test_the_zabbix_template_reads_every_value(view: View, seed: int | None) -> None:
    words = simulated(seed or 0)
    view.show(words if seed is not None else with_words(words, dict(enumerate(AS_THE_VENDOR))))
    values = view.device.snapshot.values
    for number in zabbix.TRISTAR_MULTIPLIERS:
        expected = values[named(number)]
        assert expected >= 0
        point = TRISTAR.point(named(number))
        step = 0.0 if point.emc1 is None or point.emc1.step is None else point.emc1.step
        found = zabbix.tristar_value(number, view.item(number))
        # Half a step of rounding, and what is cut after two decimals.
        assert found == pytest.approx(expected, abs=step / 2 + 0.01 + 1e-6), point.name


def test_the_zabbix_template_takes_no_negative_value(view: View) -> None:
    """Its expression wants a digit first: an array that draws a little current is unsupported there, not wrong."""
    view.show(with_words(simulated(), {0x1D: 0xFFFE}))
    assert zabbix.tristar_value(31, view.item(31)) is None
    value = view.get(31)
    assert isinstance(value, int)
    assert value < 0


FAULTS = ["overcurrent", "fets_shorted", "software_bug", "battery_hvd", "array_hvd", "dip_switch_changed"]
FAULTS += ["eeprom_edited", "rts_shorted", "rts_lost", "eeprom_retry_limit", "unused", "slave_timeout"]
"""Our names of what the template looks for, from its first bit on."""

ALARMS = ["rts_open", "rts_shorted", "rts_disconnected", "heatsink_sensor_open", "heatsink_sensor_shorted"]
ALARMS += ["heatsink_hot", "current_limit", "current_offset", "battery_sense_out_of_range"]
ALARMS += ["battery_sense_disconnected", "uncalibrated", "rts_miswire", "hvd", "unused", "system_miswire", "fet_open"]
ALARMS += ["supply_12v_out_of_range", "array_voltage_high", "adc_input_maximum", "reset"]


@pytest.mark.parametrize(("number", "names", "table"), [(55, FAULTS, "tristar_faults"), (57, ALARMS, "tristar_alarms")])
def test_the_zabbix_template_finds_every_fault(view: View, number: int, names: list[str], table: str) -> None:
    bits = {bit.name: bit.number for bit in TRISTAR.bit_tables[table]}
    at, wide = BITS[number], number == 57
    for name in names:
        if name == "unused":
            continue
        raised = 1 << bits[name]
        changes = {at: raised >> 16, at + 1: raised & 0xFFFF} if wide else {at: raised}
        view.show(with_words(simulated(), changes))
        assert zabbix.flags(view.item(number), names) == [name]
    view.show(with_words(simulated(), {at: 0, at + 1: 0}))
    assert view.get(number) == bytes(4)
    assert zabbix.flags(view.item(number), names) == []


def test_bits_of_the_day_are_those_of_now_in_four_octets(view: View) -> None:
    view.show(with_words(simulated(), {0x49: 0x0801, 0x4B: 0x0008, 0x4C: 0x0002}))
    assert (view.get(56), view.get(58)) == (b"\x80\x10\x00\x00", b"\x40\x00\x10\x00")


@pytest.mark.parametrize("state", range(10))
def test_the_zabbix_template_knows_every_charge_state(view: View, state: int) -> None:
    """Its map of values has 0 to 9, and its triggers are for 4, fault, and 2, disconnect."""
    names = ["start", "night_check", "disconnect", "night", "fault", "mppt", "absorption", "float", "equalize", "slave"]
    view.show(with_words(simulated(), {0x32: state}))
    assert view.item(46) == str(state)
    assert [each.name for each in TRISTAR.enumerations["charge_state"]] == names


@pytest.mark.peer
async def test_a_walk_by_net_snmp_has_the_vendors_types_and_librenms_detects_it(
    view: View, agent: SnmpAgent, peer: Callable[[str], str]
) -> None:
    """LibreNMS: sysObjectID begins with the vendor's number, and number 1 contains "MPPT"."""
    view.show(with_words(simulated(), {0x2C: 0x0801}))
    for listener in agent.listeners:
        await listener.start()
    try:
        bound = agent.listeners[1].bound
        assert bound is not None
        fixed = ("-v", "2c", "-c", "public", "-M", "/nonexistent", "-m", "", "-t", "2", "-r", "0", "-On")
        at = f"udp:127.0.0.1:{bound[1]}"
        _, output = await run_tool(peer("snmpwalk"), *fixed, at, DOTTED)
        _, told = await run_tool(peer("snmpget"), *fixed, at, "1.3.6.1.2.1.1.2.0", f"{DOTTED}.36.0")
    finally:
        for listener in agent.listeners:
            await listener.stop()
    found = re.findall(rf"^\.{re.escape(DOTTED)}\.(\d+)\.0 = ([\w-]+): (.*)$", output, re.MULTILINE)
    kinds = {int(number): kind for number, kind, _ in found}
    forms = {point.emc1.number: point.emc1.form for point in TRISTAR.points if point.emc1 is not None}
    types = {Emc1Form.UNSIGNED: "Gauge32", Emc1Form.BITS: "Hex-STRING"}
    assert kinds == dict.fromkeys((1, 2, 3), "STRING") | {
        number: types.get(form, "INTEGER") for number, form in forms.items()
    }
    texts = {int(number): text for number, _, text in found}
    assert "MPPT" in texts[1]
    assert texts[55].strip() == "80 10 00 00"
    assert re.search(rf"= OID: \.{re.escape(DOTTED)}$", told, re.MULTILINE)
    assert f".{DOTTED}.36.0 = INTEGER: {view.item(36)}\n" in told
