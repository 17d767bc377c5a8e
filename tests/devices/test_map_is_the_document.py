"""The map against the document: this list was written from the document alone, register by register."""

from __future__ import annotations

import struct
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.devices.decode import Decoder
from gateway.devices.model import Access, DeviceMap, Group, PollClass, Space, WordOrder
from gateway.devices.schema import load_map
from tests.devices.document import check_values, points_at, reserved_at

# address, variable, unit, kind. HI and LO name the half of a 32-bit pair that the address holds.
RAM = """
0000 sw_ver                  -     bcd
0001 n_sys_v                 ratio multiplier
0002 RESERVED
0003 RESERVED
0004 vdd_actual              V     f16
0005 adc_p12                 V     f16
0006 adc_p5                  V     f16
0007 adc_fgdrive             V     f16
0008 adc_vmeter              V     f16
0009 RESERVED
000A RESERVED
000B RESERVED
000C RESERVED
000D RESERVED
000E RESERVED
000F RESERVED
0010 adc_ic_f_shadow         A     f16
0011 adc_ia_f_shadow         A     f16
0012 adc_vbterm              V     f16
0013 adc_va_f_shadow         V     f16
0014 adc_vl                  V     f16
0015 adc_ib_f_shadow         A     f16
0016 adc_il                  A     f16
0017 adc_vbsense             V     f16
0018 adc_vb_f_1m             V     f16
0019 adc_ib_f_1m             A     f16
001A T_hs                    °C    f16
001B T_batt                  °C    f16
001C T_amb                   °C    f16
001D T_rts                   °C    f16
001E T_ind[U]                °C    f16
001F T_ind[V]                °C    f16
0020 T_ind[W]                °C    f16
0021 charge_state            -     number
0022 array_fault             -     number
0023 vb_f                    V     f16
0024 vb_ref                  V     f16
0025 vb_ref_slave            V     f16
0026 Ahc_r                   Ah    HI tenths
0027 Ahc_r                   Ah    LO tenths
0028 Ahc_t                   Ah    HI tenths
0029 Ahc_t                   Ah    LO tenths
002A kWhc_r                  kWh   tenths
002B kWhc_t                  kWh   tenths
002C Tb_lo_limit_100         °C    f16
002D Tb_lo_limit_0           °C    f16
002E load_state              -     number
002F load_fault              -     number
0030 V_lvd                   V     f16
0031 V_lhvd                  V     f16
0032 Ahl_r                   Ah    HI tenths
0033 Ahl_r                   Ah    LO tenths
0034 Ahl_t                   Ah    HI tenths
0035 Ahl_t                   Ah    LO tenths
0036 hourmeter               h     HI number
0037 hourmeter               h     LO number
0038 alarm                   -     HI number
0039 alarm                   -     LO number
003A dip_switch              -     number
003B led_state               -     number
003C Power_out               W     f16
003D Sweep_Vmp               V     f16
003E Sweep_Pmax              W     f16
003F Sweep_Voc               V     f16
0040 va_ref                  V     f16
0041 Vb_min_daily            V     f16
0042 Vb_max_daily            V     f16
0043 Ahc_daily               Ah    f16
0044 Ahl_daily               Ah    f16
0045 array_fault_daily       -     number
0046 load_fault_daily        -     number
0047 alarm_daily             -     HI number
0048 alarm_daily             -     LO number
0049 time_ab_daily           s     number
004A time_eq_daily           s     number
004B time_fl_daily           s     number
004C Va_max_daily            V     f16
004D charge_led_state        -     number
004E lighting_should_be_on   -     flag
004F va_ref_fixed            V     f16
0050 va_ref_fixed_pct        ratio f16
0051 alarm_on_setting_change -     number
"""

EEPROM = """
E000 EV_reg                  V     f16
E001 EV_float                V     f16
E002 Et_float                s     number
E003 Et_floatlb              s     number
E004 EV_floatlb_trip         V     f16
E005 EV_float_cancel         V     f16
E006 Et_float_exit_cum       s     number
E007 EV_eq                   V     f16
E008 Et_eqcalendar           d     number
E009 Et_eq_above             s     number
E00A Et_eq_reg               s     number
E00B RESERVED
E00C RESERVED
E00D alarm_on_setting_change -     number
E00E RESERVED
E00F RESERVED
E010 Evb_ref_charge_lim      V     f16
E011 RESERVED
E012 RESERVED
E013 Eib_lim                 A     f16
E014 RESERVED
E015 RESERVED
E016 RESERVED
E017 RESERVED
E018 RESERVED
E019 RESERVED
E01A EV_tempcomp             V/°C  f16
E01B EV_hvd                  V     f16
E01C EV_hvr                  V     f16
E01D Evb_ref_lim             V     f16
E01E ETb_max                 °C    signed
E01F ETb_min                 °C    signed
E020 ETb_lo_limit_100        °C    signed
E021 ETb_lo_limit_0          °C    signed
E022 EV_lvd                  V     f16
E023 EV_lvr                  V     f16
E024 EV_lhvd                 V     f16
E025 EV_lhvr                 V     f16
E026 ER_icomp                Ω     f16
E027 Et_lvd_warn             s     minutes
E028 RESERVED
E029 RESERVED
E02A RESERVED
E02B RESERVED
E02C RESERVED
E02D RESERVED
E02E RESERVED
E02F RESERVED
E030 EV_soc_g_gy             V     f16
E031 EV_soc_gy_y             V     f16
E032 EV_soc_y_yr             V     f16
E033 EV_soc_yr_r             V     f16
E034 Emodbus_id              -     number
E035 Emeter_id               -     number
E036 EVa_ref_fixed           V     f16
E037 EVa_ref_fixed_pct       ratio f16
E038 Eic_lim                 A     f16
E039 RESERVED
E03A RESERVED
E03B RESERVED
E03C RESERVED
E03D RESERVED
E03E RESERVED
E03F RESERVED
E040 Ehourmeter              h     LO number
E041 Ehourmeter              h     HI number
E042 EAhl_r                  Ah    LO tenths
E043 EAhl_r                  Ah    HI tenths
E044 EAhl_t                  Ah    LO tenths
E045 EAhl_t                  Ah    HI tenths
E046 EAhc_r                  Ah    LO tenths
E047 EAhc_r                  Ah    HI tenths
E048 EAhc_t                  Ah    LO tenths
E049 EAhc_t                  Ah    HI tenths
E04A EkWhc_r                 kWh   tenths
E04B EkWhc_t                 kWh   tenths
E04C EVb_min                 V     f16
E04D EVb_max                 V     f16
E04E EVa_max                 V     f16
E04F Etmr_eqcalendar         d     number
"""

STATE_COILS = {0x00: "Equalize triggered", 0x01: "Load disconnect", 0x02: "Charge disconnect"}
COMMAND_COILS = {
    0x10: "Clear Ah Resettable",
    0x11: "Clear Ah Total",
    0x12: "Clear kWh Resettable",
    0x14: "Clear Faults",
    0x15: "Clear Alarms",
    0x16: "Force EEPROM Update",
    0x18: "Clear kWh Total",
    0x19: "Clear Vb Min/Max",
    0x20: "Lighting Mode Test",
    0xFE: "Factory Reset",
    0xFF: "Reset Control",
}


def _rows(text: str) -> list[tuple[int, list[str]]]:
    rows = [line.split() for line in text.strip().splitlines()]
    return [(int(row[0], 16), row[1:]) for row in rows]


ROWS = _rows(RAM) + _rows(EEPROM)


def _f16(raw: int) -> float | None:
    sign, exponent, fraction = raw >> 15, raw >> 10 & 31, raw & 1023
    if exponent == 31:
        return None
    size = fraction * 2.0**-24 if exponent == 0 else (1024 + fraction) * 2.0 ** (exponent - 25)
    return -size if sign else size


def _bcd(raw: int) -> int | None:
    digits = [raw >> 12, raw >> 8 & 15, raw >> 4 & 15, raw & 15]
    return None if max(digits) > 9 else sum(digit * 10**n for n, digit in enumerate(reversed(digits)))


def _signed(raw: int) -> int | None:
    if raw <= 0x7F:
        return raw
    if 0x80 <= raw <= 0xFF:
        return raw - 0x100
    return raw - 0x10000 if raw >= 0xFF80 else None


READ: dict[str, Callable[[int], float | None]] = {
    "f16": _f16,
    "number": lambda raw: raw,
    "tenths": lambda raw: raw / 10,
    "minutes": lambda raw: raw * 60,
    "flag": lambda raw: int(raw != 0),
    "bcd": _bcd,
    "signed": _signed,
    "multiplier": lambda raw: raw if raw in range(1024) else _f16(raw),
}


@pytest.fixture(scope="module")
def prostar() -> DeviceMap:
    return load_map("prostar-mppt")


def test_list_has_every_address_once() -> None:
    assert [address for address, _ in ROWS] == [*range(0x52), *range(0xE000, 0xE050)]


@pytest.mark.parametrize(("address", "row"), [pytest.param(*row, id=f"{row[0]:04X}-{row[1][0]}") for row in ROWS])
def test_register_is_in_the_map_as_in_the_document(prostar: DeviceMap, address: int, row: list[str]) -> None:
    found = points_at(prostar, Space.REGISTERS, address)
    if row == ["RESERVED"]:
        assert not found
        assert reserved_at(prostar, Space.REGISTERS, address) == 1
        return
    assert reserved_at(prostar, Space.REGISTERS, address) == 0
    (point,) = found
    symbol, unit, *kind = row
    assert point.symbol == symbol
    assert point.unit == unit.replace("-", "")
    if kind[0] in {"HI", "LO"}:
        assert point.words == 2
        first_is_high = (kind[0] == "HI") == (address == point.address)
        assert point.reading().order is (WordOrder.HI_LO if first_is_high else WordOrder.LO_HI)
    else:
        assert point.words == 1


def _expected(first: int, words: tuple[int, ...]) -> dict[str, float]:
    """What a block holds by this file's own reading, by symbol."""
    raw: dict[str, tuple[str, int]] = {}
    for address, row in ROWS:
        if row == ["RESERVED"] or not first <= address < first + len(words):
            continue
        word = words[address - first] << (16 if row[2] == "HI" else 0)
        raw[row[0]] = (row[-1], raw.get(row[0], ("", 0))[1] + word)
    return {symbol: value for symbol, (kind, number) in raw.items() if (value := READ[kind](number)) is not None}


@pytest.mark.parametrize(("first", "count"), [(0x0000, 82), (0xE000, 80)])
@given(data=st.data())
def test_any_block_reads_as_the_document_says(first: int, count: int, data: st.DataObject) -> None:
    prostar = load_map("prostar-mppt")
    words = tuple(data.draw(st.lists(st.integers(0, 0xFFFF), min_size=count, max_size=count)))
    values = Decoder(prostar).decode(Space.REGISTERS, first, struct.pack(f">{count}H", *words))
    check_values(prostar, first, count, values, _expected(first, words))


def test_every_coil_is_a_point_or_reserved(prostar: DeviceMap) -> None:
    for address in range(0x100):
        found = points_at(prostar, Space.COILS, address)
        symbol = (STATE_COILS | COMMAND_COILS).get(address)
        assert [point.symbol for point in found] == ([] if symbol is None else [symbol])
        assert reserved_at(prostar, Space.COILS, address) == (symbol is None)
        assert [point.group for point in found] == (
            [Group.LIVE] if address in STATE_COILS else [Group.COMMAND] if symbol else []
        )


def test_what_must_be_named_to_be_written_and_what_wears(prostar: DeviceMap) -> None:
    assert {point.name for point in prostar.points if point.named_only} == {
        *("modbus_id", "meterbus_id", "factory_reset", "reset_control", "force_eeprom_update"),
        *("clear_charge_resettable", "clear_charge_total", "clear_energy_resettable", "clear_energy_total"),
        "clear_battery_voltage_extremes",
    }
    for point in prostar.points:
        in_eeprom = point.space is Space.REGISTERS and 0xE000 <= point.address <= 0xE04F
        assert prostar.wears(point) is (in_eeprom or point.name == "force_eeprom_update"), point.name


def test_ranges_are_those_of_the_device(prostar: DeviceMap) -> None:
    assert {(extent.space, extent.first, extent.last, extent.poll) for extent in prostar.extents} == {
        (Space.REGISTERS, 0x0000, 0x0051, PollClass.LIVE),
        (Space.REGISTERS, 0x8000, 0x8FFF, PollClass.BACKGROUND),
        (Space.REGISTERS, 0xE000, 0xE04F, PollClass.SETTINGS),
        (Space.COILS, 0x0000, 0x00FF, PollClass.LIVE),
    }


def test_functions_are_those_of_the_device(prostar: DeviceMap) -> None:
    assert dict(prostar.functions) == {1: Space.COILS, 2: Space.COILS, 3: Space.REGISTERS, 4: Space.REGISTERS}
    assert dict(prostar.write_functions) == {5: Space.COILS, 6: Space.REGISTERS}


def test_only_what_the_document_lets_be_written_can_be(prostar: DeviceMap) -> None:
    written = {(point.space, point.address) for point in prostar.points if point.access is Access.WRITE}
    settings = {
        address
        for address, row in _rows(EEPROM)
        if address < 0xE040 and row != ["RESERVED"] and address not in {0xE020, 0xE021}
    }
    assert written == {
        *((Space.REGISTERS, address) for address in (0x25, 0x4F, 0x50, 0x51)),
        *((Space.REGISTERS, address) for address in settings),
        *((Space.COILS, address) for address in STATE_COILS),
    }
    set_only = {point.address for point in prostar.points if point.access is Access.SET}
    assert set_only == COMMAND_COILS.keys() - {0x20}, "the lighting test stays locked until its address is confirmed"


@pytest.mark.parametrize(
    ("symbol", "minimum", "maximum"),
    [
        ("Et_float", 0, 65535),
        ("Et_eqcalendar", 0, 255),
        ("ETb_max", -128, 127),
        ("ETb_min", -128, 127),
        ("Et_lvd_warn", 0, 65535 * 60),
        ("Emodbus_id", 1, 247),
        ("Emeter_id", 1, 15),
        ("va_ref_fixed_pct", 0, 0.99),
        ("EVa_ref_fixed_pct", 0, 0.99),
        ("Eic_lim", 0, 40),
    ],
)
def test_write_limits_are_the_documents(prostar: DeviceMap, symbol: str, minimum: float, maximum: float) -> None:
    (point,) = (point for point in prostar.points if point.symbol == symbol)
    assert (point.minimum, point.maximum) == (minimum, maximum)


def test_identification_is_the_documents(prostar: DeviceMap) -> None:
    assert prostar.identity.vendor == "Morningstar Corp."
    assert set(prostar.identity.product_codes) == {"PS-MPPT-25", "PS-MPPT-25M", "PS-MPPT-40", "PS-MPPT-40M"}
    assert all(code.startswith(prostar.identity.product_prefixes) for code in prostar.identity.product_codes)
    assert (prostar.identity.serial_first, prostar.identity.serial_words) == (0xE080, 4)


def test_enumerations_have_every_value(prostar: DeviceMap) -> None:
    numbers = {name: [value.number for value in values] for name, values in prostar.enumerations.items()}
    assert numbers["charge_state"] == list(range(11))
    assert numbers["load_state"] == list(range(8))
    assert numbers["led_state"] == list(range(23))
    assert numbers["charge_led_state"] == list(range(9))
    assert numbers["setting_change_signal"] == [0, 1, 0xFFFF]
    names = {name: " ".join(value.name for value in values) for name, values in prostar.enumerations.items()}
    assert names["charge_state"] == (
        "start night_check disconnect night fault mppt absorption float equalize slave fixed"
    )
    assert names["load_state"] == "start load_on lvd_warning lvd fault disconnect load_off override"


def test_bit_tables_have_every_bit(prostar: DeviceMap) -> None:
    numbers = {name: [bit.number for bit in bits] for name, bits in prostar.bit_tables.items()}
    assert numbers["array_faults"] == list(range(12))
    assert numbers["load_faults"] == list(range(8))
    assert numbers["alarms"] == [*range(16), *range(17, 27), 28], "16 is unused, 27 unknown, 28 is firmware 13's"
    assert numbers["dip_switches"] == list(range(8))
    assert {bit.severity for bits in prostar.bit_tables.values() for bit in bits} <= {"info", "warning", "critical"}


@pytest.mark.parametrize(
    ("symbol", "table"),
    [
        ("array_fault", "array_faults"),
        ("array_fault_daily", "array_faults"),
        ("load_fault", "load_faults"),
        ("load_fault_daily", "load_faults"),
        ("alarm", "alarms"),
        ("alarm_daily", "alarms"),
        ("dip_switch", "dip_switches"),
    ],
)
def test_bit_fields_use_their_table(prostar: DeviceMap, symbol: str, table: str) -> None:
    (point,) = (point for point in prostar.points if point.symbol == symbol)
    assert point.bits == table


def test_log_layout_is_the_documents(prostar: DeviceMap) -> None:
    layout = prostar.log
    assert layout is not None
    assert (layout.first, layout.blocks, layout.block_words) == (0x8000, 256, 16)
    assert [(field.symbol, field.offset * 2, field.words * 2) for field in layout.fields] == [
        ("hourmeter", 0, 4),
        ("alarm_daily", 4, 4),
        ("load_fault_daily", 8, 4),
        ("array_fault_daily", 12, 4),
        ("Vb_min_daily", 16, 2),
        ("Vb_max_daily", 18, 2),
        ("Ahc_daily", 20, 2),
        ("Ahl_daily", 22, 2),
        ("Va_max_daily", 24, 2),
        ("time_ab_daily", 26, 2),
        ("time_eq_daily", 28, 2),
        ("time_fl_daily", 30, 2),
    ]


def test_every_shown_point_is_on_every_face(prostar: DeviceMap) -> None:
    for point in prostar.points:
        assert (point.mib is not None) == point.polled, point.name
        if point.confidence == "documented" and point.polled and not point.name.startswith("stored_charge_energy"):
            assert point.metric is not None, point.name
        if point.confidence == "low":
            assert point.metric is None, point.name


def test_what_the_field_disagrees_about_has_another_reading(prostar: DeviceMap) -> None:
    others = {
        point.address: {reading.name for reading in point.readings[1:]}
        for point in prostar.points
        if point.space is Space.REGISTERS and len(point.readings) > 1
    }
    assert others[0x01] == {"f16", "integer"}
    assert others[0x2A] == others[0x2B] == others[0xE04A] == others[0xE04B] == {"f16"}
    assert others[0xE027] == {"seconds"}
    for address in range(0xE040, 0xE04A, 2):
        assert others[address] == {"hi_lo"}
        assert points_at(prostar, Space.REGISTERS, address)[0].confidence == "low"
