"""The TriStar's map against its document: this list was written from the document alone, register by register."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.devices.decode import Decoder
from gateway.devices.model import Access, DeviceMap, Group, Kind, PollClass, Released, Space, WordOrder
from gateway.devices.plan import poll_plan
from gateway.devices.schema import load_map
from tests.devices.document import check_values, points_at, reserved_at

# address, variable, unit, kind. HI and LO name the half of a 32-bit pair that the address holds.
# V15: n·V_PU·2^-15 and so on, A the current, W both; a number and @15: n·number·2^-15; signed unless it says u.
REGISTERS = """
0000 V_PU                   V     HI part
0001 V_PU                   V     LO part
0002 I_PU                   A     HI part
0003 I_PU                   A     LO part
0004 ver_sw                 -     bcd
0005-0017 RESERVED
0018 adc_vb_f_med           V     V15
0019 adc_vbterm_f           V     V15
001A adc_vbs_f              V     V15
001B adc_va_f               V     V15
001C adc_ib_f_shadow        A     A15
001D adc_ia_f_shadow        A     A15
001E adc_p12_f              V     18.612@15
001F adc_p3_f               V     6.6@15
0020 adc_pmeter_f           V     18.612@15
0021 adc_p18_f              V     3@15
0022 adc_v_ref              V     3@15
0023 T_hs                   °C    signed
0024 T_rts                  °C    sensor
0025 T_batt                 °C    signed
0026 adc_vb_f_1m            V     V15
0027 adc_ib_f_1m            A     A15
0028 vb_min                 V     V15
0029 vb_max                 V     V15
002A hourmeter              h     HI number
002B hourmeter              h     LO number
002C fault.all              -     number
002D RESERVED
002E alarm                  -     HI number
002F alarm                  -     LO number
0030 dip.all                -     number
0031 led.state              -     number
0032 charge_state           -     number
0033 vb_ref                 V     V15
0034 Ahc_r                  Ah    HI tenths
0035 Ahc_r                  Ah    LO tenths
0036 Ahc_t                  Ah    HI tenths
0037 Ahc_t                  Ah    LO tenths
0038 kwhc_r                 kWh   number
0039 kwhc_t                 kWh   number
003A power_out_shadow       W     W17
003B power_in_shadow        W     W17
003C sweep_Pin_max          W     W17
003D sweep_vmp              V     V15
003E sweep_voc              V     V15
003F RESERVED
0040 vb_min_daily           V     V15
0041 vb_max_daily           V     V15
0042 va_max_daily           V     V15
0043 Ahc_daily              Ah    tenths
0044 whc_daily              kWh   thousandths
0045 flags_daily            -     number
0046 Pout_max_daily         W     W17
0047 Tb_min_daily           °C    signed
0048 Tb_max_daily           °C    signed
0049 fault_daily            -     number
004A RESERVED
004B alarm_daily            -     HI number
004C alarm_daily            -     LO number
004D time_ab_daily          s     number
004E time_eq_daily          s     number
004F time_fl_daily          s     number
0050-0057 RESERVED
0058 Ib_ref_slave           A     80@15
0059 vb_ref_slave           V     V15
005A va_ref_fixed           V     V15
005B va_ref_fixed_pct       ratio u1@16
1000 ProcessorB_Version     -     number
1001-100E RESERVED
100F IPAddrByte             -     text
1010 IPAddrByte             -     text
1011 SubNetMask             -     text
1012 SubNetMask             -     text
1013 Gateway                -     text
1014 Gateway                -     text
1015 PrimaryDNS             -     text
1016 PrimaryDNS             -     text
1017 SecondaryDNS           -     text
1018 SecondaryDNS           -     text
1019-101C RESERVED
101D-1024 ControllerID      -     text
1025 NetFlags               -     number
1026 MACAddress             -     text
1027 MACAddress             -     text
1028 MACAddress             -     text
1029-1030 NetBIOS_Name      -     text
151B HTTPPort               -     number
151C MBIPPort               -     number
151D NetRules               -     number
151E SNMPTrapRecPort        -     number
151F Ethernet_Power_Save_Mode - number
1520 VLAN_Enable            -     number
1521 VLAN_Parameters        -     number
E000 EV_absorp              V     V15
E001 EV_float               V     V15
E002 Et_absorp              s     number
E003 Et_absorp_ext          s     number
E004 EV_absorp_ext          V     V15
E005 EV_float_cancel        V     V15
E006 Et_float_exit_cum      s     number
E007 EV_eq                  V     V15
E008 Et_eqcalendar          d     number
E009 Et_eq_above            s     number
E00A Et_eq_reg              s     number
E00B Et_batt_service        d     number
E00C RESERVED
E00D EV_tempcomp            V/°C  uV16
E00E EV_hvd                 V     V15
E00F EV_hvr                 V     V15
E010 Evb_ref_lim            V     V15
E011 ETb_max                °C    signed
E012 ETb_min                °C    signed
E013 RESERVED
E014 RESERVED
E015 EV_soc_g_gy            V     V15
E016 EV_soc_gy_y            V     V15
E017 EV_soc_y_yr            V     V15
E018 EV_soc_yr_r            V     V15
E019 Emodbus_id             -     number
E01A Emeterbus_id           -     number
E01B RESERVED
E01C RESERVED
E01D EIb_lim                A     A15
E01E RESERVED
E01F RESERVED
E020 EVa_ref_fixed_init     V     V15
E021 EVa_ref_fixed_pct_init ratio u1@16
E022-E07F RESERVED
E080 Ehourmeter             h     LO number
E081 Ehourmeter             h     HI number
E082 EAhc_r                 Ah    LO tenths
E083 EAhc_r                 Ah    HI tenths
E084 EAhc_t                 Ah    LO tenths
E085 EAhc_t                 Ah    HI tenths
E086 EkWhc_r                kWh   number
E087 EkWhc_t                kWh   number
E088 EVb_min                V     V15
E089 EVb_max                V     V15
E08A EVa_max                V     V15
E08B Etmr_eqcalendar        d     number
E08C Etmr_batt_service      d     number
E08D-E0BF RESERVED
E0C0-E0C3 Eserial           -     text
E0C4-E0CB RESERVED
E0CC Emodel                 -     number
E0CD Ehw_version            -     text
"""

STATE_COILS = {0x00: "Equalize triggered", 0x02: "Charge disconnect"}
COMMAND_COILS = {
    0x10: "Clear Ah resettable",
    0x11: "Clear Ah total",
    0x12: "Clear kWh resettable",
    0x13: "Reset battery service calendar",
    0x14: "Clear faults",
    0x15: "Clear Alarms",
    0x16: "Force EEPROM update",
    0x18: "Clear kWh total",
    0x19: "Clear Vb_min and Vb_max",
    0xF0: "test a single phase",
    0xFF: "Reset control",
    0x1000: "Send Test Notification 1",
    0x1001: "Send Test Notification 2",
    0x1002: "Send Test Notification 3",
    0x1003: "Send Test Notification 4",
    0x10FF: "Reset Communications Server",
}


def _rows(text: str) -> Iterator[tuple[int, list[str]]]:
    for line in text.strip().splitlines():
        place, *row = line.split()
        first, _, last = place.partition("-")
        for address in range(int(first, 16), int(last or first, 16) + 1):
            yield address, row


ROWS = list(_rows(REGISTERS))
BLOCKS = [(0x0000, 0x5C), (0x1000, 0x31), (0x151B, 7), (0xE000, 0x22), (0xE080, 0x4E)]
V_PU, I_PU = 123.875, 80.5


def _signed(raw: int) -> int | None:
    if raw <= 0x7F:
        return raw
    if 0x80 <= raw <= 0xFF:
        return raw - 0x100
    return raw - 0x10000 if raw >= 0xFF80 else None


def _bcd(raw: int) -> int | None:
    return int(f"{raw:X}") if f"{raw:X}".isdigit() else None


def _by_scale(kind: str) -> Callable[[int], float]:
    """`V15`, `uV16`, `W17`, `18.612@15`."""
    unsigned = kind.startswith(("u", "W"))
    kind = kind.removeprefix("u")
    factor, _, bits = kind.partition("@") if "@" in kind else (kind[0], "", kind[1:])
    scale = {"V": V_PU, "A": I_PU, "W": V_PU * I_PU}.get(factor) or float(factor)
    return lambda raw: (raw if unsigned or raw < 0x8000 else raw - 0x10000) * scale / 2 ** int(bits)


READ: dict[str, Callable[[int], float | None]] = {
    "number": lambda raw: raw,
    "tenths": lambda raw: raw / 10,
    "thousandths": lambda raw: raw / 1000,
    "part": lambda raw: raw / 65536,
    "bcd": _bcd,
    "signed": _signed,
    "sensor": lambda raw: None if raw in {0x80, 0xFF80} else _signed(raw),
}


@pytest.fixture(scope="module")
def tristar() -> DeviceMap:
    return load_map("tristar-mppt")


def test_list_has_every_address_once() -> None:
    assert [address for address, _ in ROWS] == [
        *range(0x5C),
        *range(0x1000, 0x1031),
        *range(0x151B, 0x1522),
        *range(0xE000, 0xE0CE),
    ]


@pytest.mark.parametrize(("address", "row"), [pytest.param(*row, id=f"{row[0]:04X}-{row[1][0]}") for row in ROWS])
def test_register_is_in_the_map_as_in_the_document(tristar: DeviceMap, address: int, row: list[str]) -> None:
    found = points_at(tristar, Space.REGISTERS, address)
    if row == ["RESERVED"]:
        assert not found
        assert reserved_at(tristar, Space.REGISTERS, address) == 1
        return
    assert reserved_at(tristar, Space.REGISTERS, address) == 0
    (point,) = found
    symbol, unit, *kind = row
    assert point.symbol.replace(" ", "_") == symbol
    assert point.unit == unit.replace("-", "")
    assert (point.kind is Kind.TEXT) == (kind == ["text"])
    if kind[0] in {"HI", "LO"}:
        assert point.words == 2
        first_is_high = (kind[0] == "HI") == (address == point.address)
        assert point.reading().order is (WordOrder.HI_LO if first_is_high else WordOrder.LO_HI)
    elif kind != ["text"]:
        assert point.words == 1


def _expected(first: int, words: tuple[int, ...]) -> dict[str, float]:
    """What a block holds by this file's own reading, by symbol."""
    raw: dict[str, tuple[str, int]] = {}
    for address, row in ROWS:
        if row == ["RESERVED"] or row[-1] == "text" or not first <= address < first + len(words):
            continue
        word = words[address - first] << (16 if row[2] == "HI" else 0)
        raw[row[0]] = (row[-1], raw.get(row[0], ("", 0))[1] + word)
    read = {symbol: READ.get(kind) or _by_scale(kind) for symbol, (kind, _) in raw.items()}
    return {symbol: value for symbol, (_, number) in raw.items() if (value := read[symbol](number)) is not None}


@pytest.mark.parametrize(("first", "count"), BLOCKS)
@given(data=st.data())
def test_any_block_reads_as_the_document_says(first: int, count: int, data: st.DataObject) -> None:
    tristar = load_map("tristar-mppt")
    words = tuple(data.draw(st.lists(st.integers(0, 0xFFFF), min_size=count, max_size=count)))
    if first == 0:
        words = (123, 0xE000, 80, 0x8000, *words[4:])
    known = {"voltage_scaling": V_PU, "current_scaling": I_PU}
    values = Decoder(tristar).decode(Space.REGISTERS, first, struct.pack(f">{count}H", *words), known=known)
    check_values(tristar, first, count, values, _expected(first, words))


# ---- The worked examples of the document


def _read(words: dict[int, int]) -> dict[str, float]:
    first, last = min(words), max(words)
    data = struct.pack(f">{last - first + 1}H", *(words.get(address, 0) for address in range(first, last + 1)))
    return Decoder(load_map("tristar-mppt")).decode(Space.REGISTERS, first, data)


def test_example_voltage_scaling() -> None:
    values = _read({0x0000: 0x004E, 0x0001: 0x03A6, 0x0018: 0})
    assert values["voltage_scaling"] == pytest.approx(78.01425, abs=5e-6)


def test_example_battery_voltage() -> None:
    values = _read({0x0000: 0x007B, 0x0001: 0xE041, 0x0018: 0x0DB0})
    assert values["voltage_scaling"] == pytest.approx(123.876, abs=5e-4)
    assert values["battery_regulation_voltage"] == pytest.approx(13.25, abs=0.005)


def test_example_faults(tristar: DeviceMap) -> None:
    values = _read({0x002C: 0x0013, 0x002D: 0})
    names = [bit.name for bit in tristar.bit_tables["tristar_faults"] if int(values["array_faults"]) >> bit.number & 1]
    assert names == ["overcurrent", "fets_shorted", "array_hvd"]


def test_example_hourmeter_by_table_and_definition_and_as_printed(tristar: DeviceMap) -> None:
    """0x002213D8 are 2,233,304 hours; the table has the high word at 0x002A, the example the low one."""
    assert _read({0x002A: 0x0022, 0x002B: 0x13D8})["hourmeter"] == 2_233_304
    printed = Decoder(tristar, {"hourmeter": "lo_hi"})
    assert printed.decode(Space.REGISTERS, 0x002A, b"\x13\xd8\x00\x22")["hourmeter"] == 2_233_304


def test_example_version() -> None:
    assert _read({0x0004: 0x0012, 0x0005: 0})["software_version"] == 12


def test_example_serial_number_and_hardware_version(tristar: DeviceMap) -> None:
    words = [0x3130, 0x3332, 0x3534, 0x3736, *[0xFFFF] * 8, 1, 0x0102]
    texts = Decoder(tristar).texts(Space.REGISTERS, 0xE0C0, struct.pack(">14H", *words))
    assert texts == {"serial_number": "01234567", "hardware_version": "1.2"}


def test_addresses_and_names_of_the_network(tristar: DeviceMap) -> None:
    text = "tsmppt01234567".ljust(16, "\0").encode()
    data = struct.pack(">4H", 0xA8C0, 0xFD01, 0xFFFF, 0x00FF) + bytes(20)
    data += bytes(text[at ^ 1] for at in range(16)) + b"\x40\x00" + bytes.fromhex("1e00010cfeca")
    texts = Decoder(tristar).texts(Space.REGISTERS, 0x100F, data)
    assert texts == {
        "ip_address": "192.168.1.253",
        "subnet_mask": "255.255.255.0",
        "gateway_address": "0.0.0.0",
        "dns_primary_address": "0.0.0.0",
        "dns_secondary_address": "0.0.0.0",
        "controller_id": "tsmppt01234567",
        "mac_address": "00:1e:0c:01:ca:fe",
    }
    flags = Decoder(tristar).decode(Space.REGISTERS, 0x100F, data)["network_flags"]
    assert [bit.name for bit in tristar.bit_tables["network_flags"] if int(flags) >> bit.number & 1] == ["dhcp"]


# ---- Coils, access, tables, identification


def test_every_coil_is_a_point_or_reserved(tristar: DeviceMap) -> None:
    for address in (*range(0x100), *range(0x1000, 0x1004), 0x10FF):
        found = points_at(tristar, Space.COILS, address)
        symbol = (STATE_COILS | COMMAND_COILS).get(address)
        assert [point.symbol for point in found] == ([] if symbol is None else [symbol])
        assert reserved_at(tristar, Space.COILS, address) == (symbol is None)
        groups = [Group.LIVE] if address in STATE_COILS else [Group.COMMAND] if symbol else []
        assert [point.group for point in found] == groups


def test_ranges_are_those_of_the_device(tristar: DeviceMap) -> None:
    assert {(extent.space, extent.first, extent.last, extent.poll) for extent in tristar.extents} == {
        (Space.REGISTERS, 0x0000, 0x005B, PollClass.LIVE),
        (Space.REGISTERS, 0x1000, 0x1030, PollClass.SETTINGS),
        (Space.REGISTERS, 0x151B, 0x1521, PollClass.SETTINGS),
        (Space.REGISTERS, 0xE000, 0xE0CD, PollClass.SETTINGS),
        (Space.COILS, 0x0000, 0x00FF, PollClass.LIVE),
        (Space.COILS, 0x1000, 0x1003, PollClass.BACKGROUND),
        (Space.COILS, 0x10FF, 0x10FF, PollClass.BACKGROUND),
    }
    assert {extent.name for extent in tristar.extents if extent.products == ("TS-MPPT-60",)} == {
        *("network", "network_eeprom", "notification_coils", "communication_coil"),
    }
    assert tristar.log is None, "the document has no register of it"


def test_functions_are_those_of_the_device(tristar: DeviceMap) -> None:
    assert dict(tristar.functions) == {1: Space.COILS, 2: Space.COILS, 3: Space.REGISTERS, 4: Space.REGISTERS}
    assert dict(tristar.write_functions) == {5: Space.COILS, 6: Space.REGISTERS}


def test_all_live_values_come_in_one_read_with_their_scaling(tristar: DeviceMap) -> None:
    live = [block for block in poll_plan(tristar) if block.poll is PollClass.LIVE and block.space is Space.REGISTERS]
    assert [(block.first, block.count) for block in live] == [(0x0000, 0x5C)]


def test_only_what_the_document_lets_be_written_can_be(tristar: DeviceMap) -> None:
    written = {(point.space, point.address) for point in tristar.points if point.access is Access.WRITE}
    settings = {
        address
        for address, row in ROWS
        if row != ["RESERVED"] and (0x151B <= address <= 0x1521 or 0xE000 <= address <= 0xE021)
    }
    assert written == {
        *((Space.REGISTERS, address) for address in (0x58, 0x59, 0x5A, 0x5B)),
        *((Space.REGISTERS, address) for address in settings),
        *((Space.COILS, address) for address in STATE_COILS),
    }
    set_only = {point.address for point in tristar.points if point.access is Access.SET}
    assert set_only == COMMAND_COILS.keys() - {0xF0}, "the test mode is the factory's"


def test_what_must_be_named_to_be_written_and_what_wears(tristar: DeviceMap) -> None:
    assert {point.name for point in tristar.points if point.named_only} == {
        *("modbus_id", "meterbus_id", "reset_control", "reset_communications_server", "force_eeprom_update"),
        *("clear_charge_resettable", "clear_charge_total", "clear_energy_resettable", "clear_energy_total"),
        *("clear_battery_voltage_extremes", "reset_battery_service", "http_port", "modbus_tcp_port", "network_rules"),
        *("snmp_trap_port", "ethernet_power_save", "vlan_enable", "vlan_parameters"),
    }
    for point in tristar.points:
        in_eeprom = point.space is Space.REGISTERS and (point.address >= 0xE000 or 0x151B <= point.address <= 0x1521)
        assert tristar.wears(point) is (in_eeprom or point.name == "force_eeprom_update"), point.name


def test_slave_control_is_ended_by_a_negative_value(tristar: DeviceMap) -> None:
    held = {point.name: point for point in tristar.points if point.rewrite_s is not None}
    assert held.keys() == {"charge_current_limit_slave", "battery_target_voltage_slave"}
    assert {(point.rewrite_s, point.released) for point in held.values()} == {(60.0, Released.BY_NEGATIVE)}


def test_identification_is_the_documents(tristar: DeviceMap) -> None:
    identity = tristar.identity
    assert (identity.vendor, identity.product_codes) == ("Morningstar Corp.", ("TS-MPPT-45", "TS-MPPT-60"))
    assert (identity.serial_first, identity.serial_words, identity.serial_order) == (0xE0C0, 4, WordOrder.LO_HI)


@pytest.mark.parametrize(
    ("table", "numbers"),
    [
        ("charge_state", [*range(10)]),
        ("led_state", [*range(7), 8, *range(10, 20)]),
        ("controller_model", [0, 1]),
        ("tristar_faults", [*range(10), *range(11, 16)]),
        ("tristar_alarms", [*range(13), *range(14, 24)]),
        ("flags_today", [*range(5)]),
        ("dip_switches", [*range(8)]),
        ("network_flags", [14]),
        ("network_rules", [0]),
    ],
)
def test_tables_have_every_entry(tristar: DeviceMap, table: str, numbers: list[int]) -> None:
    tables = {name: [value.number for value in values] for name, values in tristar.enumerations.items()}
    tables |= {name: [bit.number for bit in bits] for name, bits in tristar.bit_tables.items()}
    assert tables[table] == numbers


def test_every_shown_point_is_on_every_face(tristar: DeviceMap) -> None:
    for point in tristar.points:
        assert (point.mib is not None) == point.polled, point.name
        secondary = point.confidence == "low" or point.name in {
            *("stored_hourmeter", "stored_charge_resettable", "stored_charge_total"),
            *("stored_charge_energy_resettable", "stored_charge_energy_total"),
        }
        assert (point.metric is not None) == (point.polled and not secondary), point.name
