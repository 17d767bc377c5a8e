"""`model = "auto"`: controllers of two models and a stranger, found by what they say, on every face."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from pymodbus.client import ModbusTcpClient

from gateway.devices.schema import load_map
from gateway.simulator.oracle import OracleController
from tests.e2e.fast_lines import BAUDRATE
from tests.e2e.programs import (
    GATEWAY,
    MIXED_DEVICES,
    REPOSITORY,
    Launch,
    Running,
    Start,
    environment,
    wait_until,
    write_config,
)

DEVICES = (*MIXED_DEVICES, ("shelter-b", "stranger", 3, 15))
AUTO = dict.fromkeys((name for _, name, _, _ in DEVICES), "auto")


@pytest.fixture
def site(launch: Launch, start: Start, tmp_path: Path) -> Running:
    start(sys.executable, "-m", "tests.e2e.fast_lines", str(tmp_path), "plants", "stranger")
    wait_until((tmp_path / "shelter-b").exists, "the fast lines")
    site = launch(simulate=None, devices=DEVICES, line_keys=f"baudrate = {BAUDRATE}", models=AUTO)
    site.wait_online()
    return site


def models(site: Running) -> dict[str, str]:
    """Model by device, of those that have a battery voltage now."""
    scrape = site.get("/metrics")[1]
    return dict(
        re.findall(r'^morningstar_battery_voltage_volts\{device="([^"]*)".*model="([^"]*)"', scrape, re.MULTILINE)
    )


def test_every_face_shows_what_was_found(site: Running, peer: Callable[[str], str]) -> None:
    known = {f"array-{n}": "prostar-mppt" for n in (1, 2, 3)} | {"array-4": "tristar-mppt"}
    wait_until(lambda: models(site) == known, "the models in /metrics")
    scrape = site.get("/metrics")[1]
    assert re.search(r'morningstar_up\{device="stranger",line="shelter-b",model="unknown",.*\} 1\.0', scrape)
    assert re.search(r'morningstar_condition\{device="stranger",.*condition="unknown_model"\} 1\.0', scrape)
    assert re.search(r'morningstar_device_info\{device="stranger",.*product="SS-MPPT-15L"', scrape)
    address = r'morningstar_ip_address_info\{device="array-4",.*ip_address="192\.168\.1\.\d+"\} 1\.0'
    wait_until(lambda: re.search(address, site.get("/metrics")[1]), "the settings of the TriStar")
    shown = snmp(
        peer, site, "snmpwalk", "-Oq", "pgwDeviceModel", "pgwBatteryVoltage", "pgwTristarAlarms", "pgwLoadState"
    )
    assert re.findall(r"pgwDeviceModel\.(\d+) (\S+)", shown) == [
        *(("11", "prostar-mppt"), ("12", "prostar-mppt"), ("13", "prostar-mppt"), ("14", "tristar-mppt")),
        ("15", "unknown"),
    ]
    conditions = snmp(peer, site, "snmpwalk", "-Oq", "pgwConditionState")
    assert "pgwConditionState.15.405 raised" in conditions
    assert "pgwConditionState.14.405 clear" in conditions
    assert "pgwConditionState.14.503 clear" in conditions
    assert "Unknown model" in site.get("/")[1]
    log = site.gateway.log()
    assert 'event=model_unknown device=stranger product="SS-MPPT-15L"' in log
    assert len(re.findall("event=model_found", log)) == 4
    assert len(re.findall("event=listening", log)) == 3, "listeners stay when the faces are put together anew"


def test_a_connection_outlives_the_finding_and_the_stranger_is_served_raw(site: Running) -> None:
    stranger = OracleController(load_map("prostar-mppt"), device=9, address=3)
    with ModbusTcpClient("127.0.0.1", port=site.modbus, timeout=60, retries=0) as client:
        for first, count in ((0x0000, 82), (0x8000, 112), (0xE000, 80)):
            reply = client.read_holding_registers(first, count=count, device_id=15)
            assert reply.registers == [stranger.word(address) for address in range(first, first + count)]
        assert client.read_coils(0, count=16, device_id=15).bits == [bool(stranger.coil(n)) for n in range(16)]
        assert client.read_holding_registers(0x4000, count=1, device_id=15).exception_code == 2
        assert client.write_register(0xE000, 1, device_id=15).exception_code == 1
        assert dict(client.read_device_information(device_id=15).information)[1] == b"SS-MPPT-15L"
        scaling = client.read_holding_registers(0x0000, count=4, device_id=14).registers
        assert 170 < scaling[0] < 190


def test_a_reload_keeps_what_was_found(site: Running) -> None:
    wait_until(lambda: len(models(site)) == 4, "the models in /metrics")
    config = site.folder / "site.toml"
    config.write_text(config.read_text().replace("[http]", "[cache]\nmax_age_s = 7.0\n[http]"))
    site.gateway.process.send_signal(1)
    site.gateway.wait_for(r"event=reloaded changed=\S*cache")
    assert len(models(site)) == 4
    assert len(re.findall("event=model_found", site.gateway.log())) == 4


def test_what_was_found_can_be_written_where_a_rule_allows_it(launch: Launch, start: Start, tmp_path: Path) -> None:
    start(sys.executable, "-m", "tests.e2e.fast_lines", str(tmp_path), "plants", "stranger")
    wait_until((tmp_path / "shelter-b").exists, "the fast lines")
    rule = '[[modbus.write]]\nsource = ["127.0.0.1/32"]\npoint = ["absorption_voltage"]\n'
    keys, line = "writes = true\nwrite_interval_s = 0.0", f"baudrate = {BAUDRATE}"
    site = launch(simulate=None, devices=DEVICES, line_keys=line, rest=rule, modbus_keys=keys, models=AUTO)
    wait_until(lambda: len(models(site)) == 4, "the models in /metrics")
    settings = r'morningstar_absorption_voltage_volts\{device="array-4",.*\} ([\d.]+)'
    wait_until(lambda: re.search(settings, site.get("/metrics")[1]), "the settings of the TriStar")
    with ModbusTcpClient("127.0.0.1", port=site.modbus, timeout=60, retries=0) as client:
        scaling = client.read_holding_registers(0x0000, count=2, device_id=14).registers
        word = round(56.0 * 32768 / (scaling[0] + scaling[1] / 65536))
        assert not client.write_register(0xE000, word, device_id=14).isError()
        assert client.read_holding_registers(0xE000, count=1, device_id=14).registers == [word]
        assert client.write_register(0xE001, word, device_id=14).exception_code == 1, "no rule names it"
        assert client.write_register(0xE000, word, device_id=15).exception_code == 1, "nothing is written to a stranger"

    def shown() -> bool:
        found = re.search(settings, site.get("/metrics")[1])
        return found is not None and abs(float(found[1]) - 56.0) < 0.01

    wait_until(shown, "the new setting in /metrics")


def test_check_config_accepts_it_and_says_what_it_means(tmp_path: Path) -> None:
    write_config(tmp_path / "site.toml", (1502, 1161, 9850), DEVICES, models=AUTO)
    command = [*GATEWAY, "check-config", "-c", str(tmp_path / "site.toml")]
    done = subprocess.run(
        command, cwd=REPOSITORY, capture_output=True, text=True, env={**environment(), "COLUMNS": "300"}, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert "one that is none of prostar-mppt, tristar-mppt is served by Modbus TCP alone" in done.stdout
    assert done.stdout.count("auto") >= len(DEVICES)


def snmp(peer: Callable[[str], str], site: Running, tool: str, *arguments: str) -> str:
    """What a net-snmp tool prints, one run for each object asked for."""
    mibs = f"{REPOSITORY / 'mibs'}:{REPOSITORY / 'mibs' / 'base'}"
    options = [each for each in arguments if each.startswith("-")]
    shown = []
    for name in (each for each in arguments if not each.startswith("-")):
        command = [
            peer(tool),
            "-v2c",
            "-c",
            "public",
            "-M",
            mibs,
            "-m",
            "ALL",
            *options,
            f"127.0.0.1:{site.snmp}",
            name,
        ]
        done = subprocess.run(command, capture_output=True, text=True, env=environment(), check=False)
        assert done.returncode == 0, json.dumps(done.stderr)
        shown.append(done.stdout)
    return "".join(shown)
