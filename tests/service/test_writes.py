"""From the configuration to who may write what."""

from __future__ import annotations

from pathlib import Path

import pytest

from gateway.core.write_rules import Range, Requester
from gateway.core.write_wear import WearLimits
from gateway.service.advice import advice
from gateway.service.config import parse_config
from gateway.service.settings import line_budgets, line_settings, modbus_settings

DEVICE = '[[line.device]]\nname = "d{n}"\naddress = 1\nunit_id = {n}\nmodel = "prostar-mppt"\n'
SITE = 'site = "ridge-07"\nstate_dir = "/var/lib/x"\n' + "".join(
    f'[[line]]\nname = "l{n}"\nport = "/dev/serial/by-id/usb-{n}"\n' + DEVICE.format(n=n) for n in (1, 2)
)
ON = "[modbus]\nwrites = true\n"
RULE = '[[modbus.write]]\nsource = ["192.0.2.7"]\n'


def test_writes_are_off_by_default() -> None:
    config = parse_config(SITE)
    assert modbus_settings(config).writes is None
    assert [line.writes for line in line_settings(config)] == [False, False]


def test_only_a_line_that_a_rule_is_about_ever_sends_a_write() -> None:
    config = parse_config(SITE + ON + RULE + 'unit_id = [2]\nregisters = ["0xE000"]\n')
    assert [line.writes for line in line_settings(config)] == [False, True]


def test_switched_off_rules_allow_nothing() -> None:
    config = parse_config(SITE + RULE + 'registers = ["0xE000"]\n')
    assert modbus_settings(config).writes is None
    assert [line.writes for line in line_settings(config)] == [False, False]


def test_rules_become_what_the_face_needs() -> None:
    text = ON + "eeprom_writes_per_day = 3\nwrite_interval_s = 0.5\n" + RULE
    config = parse_config(SITE + text + 'point = ["reset_control"]\nregisters = ["0xE000-0xE005"]\ncoils = ["0x1"]\n')
    settings = modbus_settings(config).writes
    assert settings is not None
    assert settings.ledger == Path("/var/lib/x")
    assert settings.limits == WearLimits(3, 0.5)
    (rule,) = settings.rules
    assert rule.holds_for(Requester("192.0.2.7"))
    assert not rule.holds_for(Requester("192.0.2.8"))
    assert rule.registers == (Range(0xE000, 0xE005),)
    assert rule.coils == (Range(1, 1),)
    assert rule.points == {"reset_control"}
    assert rule.unit_ids is None


ALLOW = 'allow = ["0.0.0.0/0"]\n'


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (ON, "modbus.writes: there is no [[modbus.write]] rule, so nobody may write"),
        (RULE + 'point = ["modbus_id"]\n', "modbus.write: has no effect as long as modbus.writes is false"),
        (
            ON + ALLOW + '[[modbus.write]]\nsource = ["0.0.0.0/0"]\npoint = ["modbus_id"]\n',
            "modbus.write[0].source[0]: 0.0.0.0/0 is everybody",
        ),
        (
            ON + ALLOW + '[[modbus.write]]\nsource = ["192.0.2.0/30"]\npoint = ["modbus_id"]\n',
            "modbus.write[0].source[0]: each of 4 addresses (192.0.2.0/30) may write",
        ),
        (
            ON + ALLOW + RULE + 'point = ["modbus_id"]\nregisters = ["0xE030-0xE035"]\n',
            "modbus.write[0]: to be written, these must be named in point, whatever the ranges: meterbus_id",
        ),
        (
            ON + 'allow = ["198.51.100.0/24", "::1/128"]\n' + RULE + 'point = ["modbus_id"]\n',
            "modbus.write[0].source[0]: 192.0.2.7/32 may not connect at all (modbus.allow)",
        ),
    ],
)
def test_advice_about_writing(text: str, expected: str) -> None:
    config = parse_config(SITE + text)
    given = [line for line in advice(config, line_budgets(config)) if line.startswith("modbus.write")]
    assert [line for line in given if "EEPROM" not in line] == [expected]


@pytest.mark.parametrize(
    ("rule", "named"),
    [
        ('point = ["absorption_time", "equalize_triggered"]', "absorption_time"),
        ('registers = ["0xE000-0xE002"]', "absorption_voltage, float_voltage, absorption_time"),
        ('registers = ["0xE000-0xE005"]', "absorption_voltage, float_voltage, absorption_time and 3 more"),
        ('point = ["reset_control"]\nregisters = ["0x0025"]\ncoils = ["0x0000-0x0002"]', ""),
    ],
)
def test_it_says_what_a_change_of_a_setting_does_to_the_controller(rule: str, named: str) -> None:
    config = parse_config(SITE + ON + RULE + rule + "\n")
    expected = (
        f"modbus.write[0]: a write to {named} goes to the controller's EEPROM and can raise its setting-changed fault, "
        "which may keep charging and the load off until the controller is reset"
    )
    given = [line for line in advice(config, line_budgets(config)) if "EEPROM" in line]
    assert given == ([expected] if named else [])
