"""F53: what was recorded before a restart is not answered after it, with a fresh TMPDIR as well."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from pysnmp.proto.api import v2c

from gateway.faces.snmp.agent import SnmpAgent
from tests.faces.snmp.poller import USM_STATS, Poller, a_user, pdu, statistic
from tests.faces.snmp.stub_site import StubClock
from tests.faces.snmp.test_responder import SYS_DESCR


def test_a_recorded_message_is_outside_of_the_window_after_a_restart(
    make_agent: Callable[..., SnmpAgent], clock: StubClock, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    agents = []
    recorded, recorded_id = b"", 0
    for start in range(3):
        monkeypatch.setenv("TMPDIR", str(tmp_path / f"tmp{start}"))
        agent = make_agent(users=(a_user(),), state_dir=tmp_path / "state")
        agent.prepare()
        agents.append(agent)
        poller = Poller(lambda data, agent=agent: agent.answer(data, "127.0.0.1"))  # type: ignore[misc]
        poller.sign_in()
        assert poller.authority.boots == start + 1
        if recorded:
            known = poller.message_id
            poller.message_id = recorded_id
            reply = agent.answer(recorded, "127.0.0.1")
            assert reply is not None
            assert statistic(poller.read(reply), (*USM_STATS, 2, 0)) >= 1
            poller.message_id = known
        recorded = poller.sealed(pdu(v2c.GetRequestPDU, SYS_DESCR))
        recorded_id = poller.message_id
        reply = agent.answer(recorded, "127.0.0.1")
        assert reply is not None
        assert poller.read(reply).names == [SYS_DESCR]
    assert [agent.counters.not_in_time_windows for agent in agents] == [1, 2, 2]


def test_and_after_150_seconds_without_one(make_agent: Callable[..., SnmpAgent], clock: StubClock) -> None:
    agent = make_agent(users=(a_user(),))
    agent.prepare()
    poller = Poller(lambda data: agent.answer(data, "127.0.0.1"))
    poller.sign_in()
    recorded = poller.sealed(pdu(v2c.GetRequestPDU, SYS_DESCR))
    clock.now += 150
    assert poller.read(agent.answer(recorded, "127.0.0.1") or b"").kind == "ResponsePDU"
    clock.now += 1
    report = poller.read(agent.answer(recorded, "127.0.0.1") or b"")
    assert statistic(report, (*USM_STATS, 2, 0)) == 2
    assert report.flags == 1  # signed, so that the asker can believe the time in it
    assert (report.boots, report.time) == (1, 151)
