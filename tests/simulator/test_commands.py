"""Every write rule of the document, one test each."""

from __future__ import annotations

import struct
from typing import Any

import pytest

Client = Any

FAULTED = "eeprom_edited"


def half(value: float) -> int:
    return int.from_bytes(struct.pack(">e", value), "big")


def minutes(client: Client, count: float) -> None:
    client.now += 60 * count


def setting_edited(client: Client) -> bool:
    array = client.bit("array_faults", FAULTED)
    assert client.bit("load_faults", FAULTED) is array
    return bool(array)


def test_an_eeprom_write_is_confirmed_kept_and_faults_until_reset(client: Client) -> None:
    assert not setting_edited(client)
    request = client.write("absorption_voltage", half(14.1))
    assert request == bytes([6, 0xE0, 0x00, *half(14.1).to_bytes(2, "big")])
    assert client.get("absorption_voltage") == pytest.approx(14.1, abs=0.01)
    assert setting_edited(client)
    minutes(client, 1)
    assert client.state("charge_state") == "fault"
    assert client.state("load_state") == "fault"
    client.write("clear_faults", 1)
    assert setting_edited(client)
    client.write("reset_control", 1)
    minutes(client, 1)
    assert not setting_edited(client)
    assert client.state("charge_state") == "mppt"
    assert client.state("load_state") == "load_on"
    assert client.get("absorption_voltage") == pytest.approx(14.1, abs=0.01)
    assert client.bit("array_faults_today", FAULTED)


def test_the_device_verifies_nothing(client: Client) -> None:
    assert client.write("absorption_voltage", 0x7E00) is not None
    assert client.get("absorption_voltage") is None


def test_with_the_ram_switch_an_eeprom_write_is_an_alarm_until_reset(client: Client) -> None:
    client.write("setting_change_signal", 1)
    assert not setting_edited(client)
    client.write("float_voltage", half(13.5))
    assert not setting_edited(client)
    assert client.bit("alarms", "setting_changed")
    client.write("clear_alarms", 1)
    assert client.bit("alarms", "setting_changed")
    client.write("reset_control", 1)
    minutes(client, 1)
    assert not client.bit("alarms", "setting_changed")
    assert client.get("setting_change_signal") == 0


def test_the_stored_switch_faults_once_and_holds_from_the_next_reset(client: Client) -> None:
    assert client.get("stored_setting_change_signal") == 0xFFFF
    client.write("stored_setting_change_signal", 1)
    assert setting_edited(client)
    client.write("reset_control", 1)
    minutes(client, 1)
    assert client.get("setting_change_signal") == 1
    client.write("float_voltage", half(13.5))
    assert not setting_edited(client)


def test_before_firmware_13_there_is_only_the_fault(make_client: Any) -> None:
    client = make_client(firmware=12)
    assert client.words(client.controller.map.point("software_version").address, 1) == [0x0012]
    client.write("setting_change_signal", 1)
    client.write("float_voltage", half(13.5))
    assert setting_edited(client)
    assert not client.bit("alarms", "setting_changed")


@pytest.mark.parametrize("name", ["battery_voltage", "charge_total", "stored_hourmeter", "time_since_equalize"])
def test_read_only_registers_refuse_writes(client: Client, name: str) -> None:
    before = client.get(name)
    assert client.write(name, 0x1234) == bytes([0x86, 2])
    assert client.get(name) == before
    assert not setting_edited(client)


@pytest.mark.parametrize(("function", "address"), [(6, 0x0002), (6, 0xE00B), (6, 0x8000), (5, 0x0003), (5, 0x001A)])
def test_reserved_cells_refuse_writes(client: Client, function: int, address: int) -> None:
    assert client.request(function, address, 0xFF00) == bytes([function | 0x80, 2])


def test_reset_is_not_answered_and_leaves_a_gap(client: Client) -> None:
    assert client.write("reset_control", 1) is None
    client.now = 2.9
    assert client.request(3, 0, 1) is None
    client.now = 3.1
    assert client.request(3, 0, 1) is not None
    assert client.bit("alarms", "reset")
    client.write("clear_alarms", 1)
    assert not client.bit("alarms", "reset")


def test_resetting_with_0_does_nothing(client: Client) -> None:
    assert client.write("reset_control", 0) is not None
    assert client.write("factory_reset", 0) is not None
    assert client.request(3, 0, 1) is not None


def test_factory_reset_reverts_settings_and_the_address(make_client: Any) -> None:
    client = make_client(address=7)
    client.write("float_voltage", half(13.1))
    assert client.write("factory_reset", 1) is None
    client.now = 4.0
    assert client.get("float_voltage") == pytest.approx(13.7, abs=0.01)
    assert client.controller.address == 1
    assert not setting_edited(client)


def test_a_new_modbus_address_holds_from_the_next_reset(client: Client) -> None:
    client.write("modbus_id", 9)
    assert client.controller.address == 1
    client.write("reset_control", 1)
    assert client.controller.address == 9


@pytest.mark.parametrize("stored", [0, 248, 0xFFFF])
def test_an_impossible_modbus_address_is_not_taken(client: Client, stored: int) -> None:
    client.write("modbus_id", stored)
    client.write("reset_control", 1)
    assert client.controller.address == 1


@pytest.mark.parametrize(
    ("coil", "cleared", "kept"),
    [
        (
            "clear_charge_resettable",
            ("charge_resettable", "load_charge_resettable"),
            ("charge_total", "load_charge_total"),
        ),
        ("clear_charge_total", ("charge_total", "load_charge_total"), ("charge_resettable", "load_charge_resettable")),
        ("clear_energy_resettable", ("charge_energy_resettable",), ("charge_energy_total",)),
        ("clear_energy_total", ("charge_energy_total",), ("charge_energy_resettable",)),
    ],
)
def test_clearing_counters(client: Client, coil: str, cleared: tuple[str, ...], kept: tuple[str, ...]) -> None:
    client.write(coil, 0)
    assert all(client.get(name) > 0 for name in cleared + kept)
    assert client.write(coil, 1) is not None
    assert [client.get(name) for name in cleared] == [0] * len(cleared)
    assert all(client.get(name) > 0 for name in kept)
    assert client.get(coil) == 0
    assert not setting_edited(client)


def test_force_eeprom_update_copies_the_totals(client: Client) -> None:
    minutes(client, 120)
    assert client.get("stored_charge_total") < client.get("charge_total")
    client.write("force_eeprom_update", 1)
    for live in ("hourmeter", "charge_total", "charge_energy_total", "load_charge_total", "load_charge_resettable"):
        assert client.get(f"stored_{live}") == client.get(live)
    assert client.get("force_eeprom_update") == 0
    assert not setting_edited(client)


def test_eeprom_totals_follow_once_a_day_by_themselves(client: Client) -> None:
    before = client.get("stored_hourmeter")
    minutes(client, 10 * 60)
    assert client.get("stored_hourmeter") == before
    minutes(client, 14 * 60)
    assert client.get("stored_hourmeter") == pytest.approx(before + 15, abs=1)


def test_clearing_the_battery_extremes(client: Client) -> None:
    minutes(client, 180)
    assert client.get("battery_voltage_minimum_today") < client.get("battery_voltage")
    client.write("clear_battery_voltage_extremes", 1)
    volts = client.get("battery_voltage")
    for name in ("battery_voltage_minimum_today", "battery_voltage_maximum_today", "battery_voltage_minimum_stored"):
        assert client.get(name) == volts


def test_charge_disconnect_stops_charging_until_it_is_cleared(client: Client) -> None:
    assert client.get("charge_current") > 1
    client.write("charge_disconnect_forced", 1)
    minutes(client, 1)
    assert client.get("charge_disconnect_forced") == 1
    assert client.state("charge_state") == "disconnect"
    assert client.get("charge_current") == 0
    assert client.get("battery_current_net") < 0
    client.write("charge_disconnect_forced", 0)
    minutes(client, 1)
    assert client.state("charge_state") == "mppt"
    assert client.get("charge_current") > 1


def test_load_disconnect_cuts_the_load_until_it_is_cleared(client: Client) -> None:
    assert client.get("load_current") > 1
    client.write("load_disconnect_forced", 1)
    minutes(client, 1)
    assert client.state("load_state") == "disconnect"
    assert client.get("load_current") == 0
    assert client.get("load_voltage") == 0
    client.write("load_disconnect_forced", 0)
    minutes(client, 1)
    assert client.get("load_current") > 1


def test_a_reset_ends_disconnects(client: Client) -> None:
    client.write("load_disconnect_forced", 1)
    client.write("reset_control", 1)
    minutes(client, 1)
    assert client.get("load_disconnect_forced") == 0


def test_slave_control_lasts_as_long_as_it_is_refreshed(client: Client) -> None:
    for _ in range(3):
        client.write("battery_target_voltage_slave", half(13.0))
        client.now += 59.0
        assert client.state("charge_state") == "slave"
        assert client.get("battery_target_voltage") == pytest.approx(13.0, abs=0.01)
    client.now += 2.0
    assert client.bit("array_faults", "slave_timeout")
    minutes(client, 1)
    assert client.state("charge_state") == "fault"
    client.write("battery_target_voltage_slave", half(13.2))
    assert not client.bit("array_faults", "slave_timeout")
    client.now += 30.0
    assert client.state("charge_state") == "slave"


def test_writing_0_leaves_slave_control(client: Client) -> None:
    client.write("battery_target_voltage_slave", half(13.0))
    client.now += 30.0
    client.write("battery_target_voltage_slave", 0)
    minutes(client, 5)
    assert client.state("charge_state") == "mppt"
    assert not client.bit("array_faults", "slave_timeout")


def test_clearing_faults_ends_a_slave_timeout(client: Client) -> None:
    client.write("battery_target_voltage_slave", half(13.0))
    client.now += 61.0
    assert client.bit("array_faults", "slave_timeout")
    client.write("clear_faults", 1)
    assert not client.bit("array_faults", "slave_timeout")


def test_a_fixed_array_voltage_replaces_tracking(client: Client) -> None:
    client.write("array_fixed_voltage", half(30.0))
    minutes(client, 1)
    assert client.state("charge_state") == "fixed"
    assert client.get("array_voltage") == pytest.approx(30.0, abs=0.02)
    assert client.get("array_target_voltage") == pytest.approx(30.0, abs=0.02)
    client.write("array_fixed_voltage", 0)
    minutes(client, 15)
    assert client.state("charge_state") == "mppt"
    assert not setting_edited(client)


def test_a_fixed_fraction_gives_way_to_a_fixed_voltage(client: Client) -> None:
    client.write("array_fixed_fraction", half(0.75))
    minutes(client, 1)
    assert client.state("charge_state") == "fixed"
    assert client.get("array_voltage") == pytest.approx(0.75 * client.get("sweep_voc"), rel=0.1)
    client.write("array_fixed_voltage", half(28.0))
    minutes(client, 1)
    assert client.get("array_voltage") == pytest.approx(28.0, abs=0.02)


def test_a_reset_copies_the_stored_array_voltage(client: Client) -> None:
    client.write("stored_array_fixed_voltage", half(29.0))
    assert client.get("array_fixed_voltage") == 0
    client.write("reset_control", 1)
    minutes(client, 1)
    assert client.get("array_fixed_voltage") == 29.0
    assert client.state("charge_state") == "fixed"


def test_equalize_is_triggered_runs_and_clears_its_coil(client: Client) -> None:
    client.write("equalize_triggered", 1)
    assert client.get("equalize_triggered") == 1
    seen = set()
    for _ in range(9 * 12):
        minutes(client, 5)
        seen.add(client.state("charge_state"))
    assert "equalize" in seen
    assert client.get("equalize_triggered") == 0
    assert client.get("time_since_equalize") == 0
    assert client.get("equalize_time_today") >= 3600


def test_equalize_cannot_be_triggered_when_disabled(client: Client) -> None:
    client.write("equalize_voltage", 0)
    client.write("equalize_triggered", 1)
    assert client.get("equalize_triggered") == 0


def test_the_lighting_test_is_confirmed_and_reads_0(client: Client) -> None:
    assert client.write("lighting_test", 1) is not None
    assert client.get("lighting_test") == 0


def test_writes_are_noted_and_refused_ones_not(client: Client) -> None:
    client.write("battery_voltage", 1)
    client.write("float_voltage", half(13.5))
    assert [(space.value, address) for space, address, _ in client.controller.writes] == [("registers", 0xE001)]
