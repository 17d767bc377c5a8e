"""A configuration that another process reads is the same one, and what keeps it from being read is no verdict on it."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.errors import ConfigError, ReadingFailed
from gateway.service.config import load_config, parse_config
from gateway.service.plain import PlainTable, as_mapping, from_json, to_json, with_values
from gateway.service.reading import Reading, _result, read_config
from gateway.service.schema import Config, LineTable, ModbusTable
from tests.docs.blocks import ROOT

CONFIGS = ROOT / "config"

values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(),
    lambda inner: (
        st.lists(inner, max_size=4).map(tuple)
        | st.dictionaries(st.text(), inner, max_size=4)
        | st.dictionaries(st.text("abc", min_size=1), inner, max_size=4).map(PlainTable)
    ),
)


@pytest.mark.parametrize("name", ["full.toml", "minimal.toml"])
def test_it_is_the_configuration_that_is_read_here(name: str) -> None:
    assert read_config(CONFIGS / name) == load_config(CONFIGS / name)


def test_every_key_of_the_schema_is_an_attribute_with_its_value() -> None:
    text = (CONFIGS / "minimal.toml").read_text()
    config = parse_config(text)
    assert set(vars(config)) == set(Config.model_fields)
    assert set(vars(config.line[0])) == set(LineTable.model_fields)
    assert set(vars(config.modbus)) == set(ModbusTable.model_fields)
    assert config.line[0].device[0].unit_id == as_mapping(config)["line"][0]["device"][0]["unit_id"]


def test_every_problem_comes_over(tmp_path: Path) -> None:
    path = tmp_path / "bad.toml"
    path.write_text('site = 5\n[modbus]\nlistne = []\n"b\u00e4d" = 1\n', encoding="utf-8")
    with pytest.raises(ConfigError) as here:
        load_config(path)
    with pytest.raises(ConfigError) as there:
        read_config(path)
    assert there.value.problems == here.value.problems
    assert len(there.value.problems) > 2


def test_a_file_that_is_not_there_is_a_problem_of_the_file(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot be read: No such file"):
        read_config(tmp_path / "nothing.toml")


def test_where_it_is_started_makes_no_difference(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "gateway").mkdir()
    for name in ("gateway/__init__.py", "json.py", "pydantic.py"):
        (tmp_path / name).write_text("raise SystemExit(9)")
    monkeypatch.chdir(tmp_path)
    assert read_config(CONFIGS / "minimal.toml") == load_config(CONFIGS / "minimal.toml")


def test_a_folder_that_is_gone_is_no_verdict(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    gone = tmp_path / "gone"
    gone.mkdir()
    monkeypatch.chdir(gone)
    monkeypatch.syspath_prepend("")
    gone.rmdir()
    with pytest.raises(ReadingFailed, match=r"minimal\.toml: no process can be started to read it: No such file"):
        read_config(CONFIGS / "minimal.toml")


@pytest.mark.parametrize("program", ["/bin/false", "/bin/true", "/nothing/here"])
def test_a_process_that_does_not_answer_is_no_verdict(monkeypatch: pytest.MonkeyPatch, program: str) -> None:
    monkeypatch.setattr(sys, "executable", program)
    with pytest.raises(ReadingFailed, match=r"minimal\.toml: "):
        read_config(CONFIGS / "minimal.toml")


def test_one_that_takes_too_long_is_ended(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    slow = tmp_path / "slow"
    slow.write_text("#!/bin/sh\nexec sleep 100\n")
    slow.chmod(0o700)
    monkeypatch.setattr(sys, "executable", str(slow))
    monkeypatch.setattr("gateway.service.reading.READ_S", 0.01)
    with Reading(CONFIGS / "minimal.toml") as reading, pytest.raises(ReadingFailed, match="is not read after"):
        reading.result()
    with pytest.raises(ProcessLookupError):
        os.kill(reading._process.pid, 0)


@pytest.mark.parametrize("written", [b"", b"x", b"[]", b"{}", b'{"config": 5}', b'{"config": {"mapping": {}}}'])
def test_an_answer_that_is_none_is_no_verdict(written: bytes) -> None:
    with pytest.raises(ReadingFailed, match="otherwise"):
        _result(written, "otherwise")


def test_the_environment_is_handed_on_and_nothing_is_said_on_the_way(capfd: pytest.CaptureFixture[str]) -> None:
    assert read_config(CONFIGS / "minimal.toml").site
    assert capfd.readouterr() == ("", "")


@given(values)
def test_any_table_comes_back(value: object) -> None:
    found = from_json(json.loads(json.dumps(to_json(value))))
    assert found == value
    assert str(as_mapping(found)) == str(as_mapping(value))  # 1 and 1.0 are equal otherwise


def test_a_table_is_not_changed_and_shows_no_value() -> None:
    table = PlainTable({"name": "public", "inner": PlainTable({"key": 1})})
    with pytest.raises(AttributeError, match="is not changed: name"):
        table.name = "other"
    assert "public" not in repr(table)
    assert with_values(table, {"name": "x"}) == PlainTable({"name": "x", "inner": PlainTable({"key": 1})})
    assert hash(table) == hash(with_values(table, {"name": "x"}))
    with pytest.raises(KeyError, match="other"):
        with_values(table, {"other": 1})


def test_the_program_says_what_came_of_it() -> None:
    command = [sys.executable, "-m", "gateway.service.reading", str(CONFIGS / "minimal.toml")]
    said = subprocess.run(command, capture_output=True, check=True, cwd=ROOT)
    assert json.loads(said.stdout)["config"]["table"]["site"] == load_config(CONFIGS / "minimal.toml").site


def test_who_does_not_wait_for_the_answer_ends_its_process() -> None:
    with Reading(CONFIGS / "minimal.toml") as reading:
        pass
    assert reading._process.returncode == -signal.SIGKILL


def test_an_answer_that_nobody_takes_is_no_matter() -> None:
    receiving, sending = os.pipe()
    os.close(receiving)
    command = [sys.executable, "-m", "gateway.service.reading", str(CONFIGS / "minimal.toml")]
    said = subprocess.run(command, stdout=sending, stderr=subprocess.PIPE, check=False, cwd=ROOT)
    os.close(sending)
    assert said.stderr == b""
