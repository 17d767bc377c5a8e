"""F52: a lost or damaged state means a new engine id, said so, or no SNMPv3: never boots 1 under the old one."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from pysnmp.proto.api import v2c

from gateway.faces.snmp.agent import SnmpAgent
from gateway.faces.snmp.engine import FILE_NAME, MAX_BOOTS, EngineLost, start_engine, state_text
from tests.faces.snmp.poller import Poller, a_user
from tests.faces.snmp.test_responder import SYS_DESCR, request


@pytest.mark.parametrize("content", [None, b"", b"engine_id 80\nboots 1\n", b"\0" * 100])
def test_a_new_engine_id_is_taken_and_announced(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, content: bytes | None
) -> None:
    old = start_engine(tmp_path, 32473, 0.0)
    start_engine(tmp_path, 32473, 0.0)
    caplog.clear()
    if content is None:
        (tmp_path / FILE_NAME).unlink()
    else:
        (tmp_path / FILE_NAME).write_bytes(content)

    new = start_engine(tmp_path, 32473, 0.0)

    assert new.engine_id != old.engine_id
    assert new.boots == 1
    assert start_engine(tmp_path, 32473, 0.0).boots == 2
    (line,) = [record.getMessage() for record in caplog.records]
    assert line.startswith(f"event=snmp_engine_new engine_id={new.engine_id.hex()} file=")
    assert ("missing" if content is None else "damaged") in line


@pytest.mark.parametrize("content", [None, b"garbage"])
def test_or_it_is_refused(tmp_path: Path, content: bytes | None) -> None:
    start_engine(tmp_path, 32473, 0.0)
    (tmp_path / FILE_NAME).unlink()
    if content is not None:
        (tmp_path / FILE_NAME).write_bytes(content)
    with pytest.raises(EngineLost, match="missing" if content is None else "damaged"):
        start_engine(tmp_path, 32473, 0.0, renew=False)
    assert content is None or (tmp_path / FILE_NAME).read_bytes() == content


def test_boots_that_are_used_up_need_a_new_engine_id(tmp_path: Path) -> None:
    (tmp_path / FILE_NAME).write_bytes(state_text(b"12345", MAX_BOOTS))
    engine = start_engine(tmp_path, 32473, 0.0)
    assert (engine.engine_id != b"12345", engine.boots) == (True, 1)


def test_what_cannot_be_written_is_not_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    old = start_engine(tmp_path, 32473, 0.0)

    def full(*_: object) -> int:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.write", full)
    engine = start_engine(tmp_path, 32473, 0.0)
    assert engine.engine_id != old.engine_id
    with pytest.raises(EngineLost, match="No space left"):
        start_engine(tmp_path, 32473, 0.0, renew=False)
    monkeypatch.undo()
    assert start_engine(tmp_path, 32473, 0.0) != old
    assert start_engine(tmp_path, 32473, 0.0).engine_id == old.engine_id


def test_an_agent_that_may_not_renew_serves_the_rest(
    make_agent: Callable[..., SnmpAgent], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    agent = make_agent(users=(a_user(),), state_dir=tmp_path, renew_engine=False)
    agent.prepare()
    assert "event=snmp_v3_off" in caplog.text
    assert agent.answer(request(v2c.GetRequestPDU, SYS_DESCR), "127.0.0.1") is not None
    poller = Poller(lambda data: agent.answer(data, "127.0.0.1"))
    assert poller.exchange(poller.sealed(b"", 4)) is None
    assert agent.counters.bad_versions == 1
