"""`prostar-gateway writes`: the ledger for people and for programs."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from gateway.cli.app import app
from gateway.core.write_ledger import Fate, Intent, Record, Verdict
from gateway.devices.model import Space
from gateway.faces.modbus.ledger import LedgerFile

NOW = 1_800_000_000.0
CONFIG = """
site = "ridge-07"
state_dir = "{folder}/state"
[[line]]
name = "shelter-a"
port = "/dev/serial/by-id/usb-a"
[[line.device]]
name = "array-1"
address = 1
unit_id = 11
model = "prostar-mppt"
"""


def intent(id_: str, unit: int = 11, **changes: object) -> Intent:
    values: dict[str, object] = {
        "peer": "192.0.2.7",
        "role": None,
        "device": "array-1",
        "point": "float_voltage",
        "space": Space.REGISTERS,
        "address": 0xE001,
        "old": 0x4AE6,
        "new": 0x4B00,
        "wears": True,
        **changes,
    }
    return Intent(id_, NOW, unit_id=unit, **values)  # type: ignore[arg-type]  # the fields by their names


@pytest.fixture
def config(tmp_path: Path) -> Path:
    path = tmp_path / "site.toml"
    path.write_text(CONFIG.format(folder=tmp_path))
    return path


def note(config: Path, *records: Record) -> None:
    ledger = LedgerFile(config.parent / "state")
    ledger.open()
    ledger.append(records)


def run(config: Path, *options: str) -> str:
    done = CliRunner(env={"COLUMNS": "160"}).invoke(app, ["writes", "-c", str(config), *options])
    assert done.exit_code == 0, done.output
    return done.output


def test_before_the_first_write(config: Path) -> None:
    assert run(config) == f"No writes are noted in {config.parent / 'state'}.\n"


@pytest.mark.parametrize(
    ("records", "expected"),
    [
        ((intent("a"),), "unknown: the gateway ended before it was told"),
        ((intent("a"), Verdict("a", NOW, Fate.WRITTEN, found=0x4B00)), "written"),
        ((intent("a"), Verdict("a", NOW, Fate.DIFFERS, 4, 0x4B01)), "differs, exception 04, holds 0x4B01"),
        ((intent("a"), Verdict("a", NOW, Fate.UNKNOWN, 0x0B)), "unknown, exception 0B"),
        ((intent("a", left_out=7), Verdict("a", NOW, Fate.WRITTEN)), "written (7 rewrites before it are not listed)"),
    ],
)
def test_how_each_write_ended(config: Path, records: tuple[Record, ...], expected: str) -> None:
    note(config, *records)
    (row,) = [line for line in run(config).splitlines() if "192.0.2.7" in line]
    assert row.rstrip().endswith(expected)
    assert row.split()[2:8] == ["192.0.2.7", "11", "float_voltage", "0xE001", "0x4AE6", "0x4B00"]


def test_a_narrow_terminal_breaks_no_word(config: Path) -> None:
    note(config, intent("a", point="float_voltage"), Verdict("a", NOW, Fate.WRITTEN, found=0x4B00))
    done = CliRunner(env={"COLUMNS": "80"}).invoke(app, ["writes", "-c", str(config)])
    for word in ("2027-01-15", "08:00:00Z", "192.0.2.7", "float_voltage", "0x4B00", "written"):
        assert word in done.output


def test_coils_roles_and_what_is_not_known(config: Path) -> None:
    note(config, intent("a", space=Space.COILS, address=0xFF, old=None, new=1, role="[b]operator[/b]"))
    text = run(config)
    assert "192.0.2.7 ([b]operator[/b])" in text, "shown as it is"
    assert "0x00FF coil" in text
    assert " ? " in text


def test_the_latest_of_one_unit(config: Path) -> None:
    for number in range(5):
        note(config, intent(f"{number}", unit=11 + number % 2, new=number))
    found = [json.loads(line) for line in run(config, "--json", "--unit", "11", "--last", "2").splitlines()]
    assert [(entry["intent"]["id"], entry["intent"]["unit_id"]) for entry in found] == [("2", 11), ("4", 11)]


def test_a_ledger_that_cannot_be_read(config: Path) -> None:
    (config.parent / "state" / "writes.jsonl").mkdir(parents=True)
    done = CliRunner().invoke(app, ["writes", "-c", str(config)])
    assert done.exit_code == 1
    assert "the ledger cannot be read: Is a directory" in done.output


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "Writes refused"),
        ("[modbus]\nwrites = true\n", "Writes refused"),
        (
            '[modbus]\nwrites = true\n[[modbus.write]]\nsource = ["127.0.0.1"]\npoint = ["reset_control"]\n',
            "Writes as far as 1 rule allows, on shelter-a",
        ),
        (
            "[modbus]\nwrites = true\n" + 2 * '[[modbus.write]]\nsource = ["127.0.0.1"]\ncoils = ["0x1"]\n',
            "Writes as far as 2 rules allow, on shelter-a",
        ),
    ],
)
def test_check_config_says_where_writes_can_go_out(config: Path, text: str, expected: str) -> None:
    config.write_text(config.read_text() + text)
    done = CliRunner(env={"COLUMNS": "160"}).invoke(app, ["check-config", "-c", str(config)])
    assert done.exit_code == 0, done.output
    assert expected in done.output.splitlines()
