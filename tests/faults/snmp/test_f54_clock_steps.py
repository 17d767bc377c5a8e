"""F54: the wall clock may step by hours or years: engine time, uptime and replies do not notice."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from pysnmp.proto.api import v2c

from gateway.faces.snmp.agent import SnmpAgent
from tests.faces.snmp.poller import Poller, a_user
from tests.faces.snmp.stub_site import StubClock
from tests.faces.snmp.test_responder import SYS_UP_TIME

HOUR, YEAR = 3600.0, 365.25 * 86400.0


@pytest.mark.parametrize("step_s", [HOUR, -HOUR, YEAR, -YEAR, 1.79e9])
def test_a_step_of_the_wall_clock_changes_nothing(
    make_agent: Callable[..., SnmpAgent], clock: StubClock, monkeypatch: pytest.MonkeyPatch, step_s: float
) -> None:
    wall = 0.0 if step_s == 1.79e9 else 1.79e9  # 1970 to now
    monkeypatch.setattr("time.time", lambda: wall)
    monkeypatch.setattr(StubClock, "wall", lambda self: wall)
    agent = make_agent(users=(a_user(),))
    agent.prepare()
    poller = Poller(lambda data: agent.answer(data, "127.0.0.1"))
    poller.sign_in()
    clock.now += 10
    wall += step_s
    found = poller.ask(v2c.GetRequestPDU, SYS_UP_TIME)
    assert found is not None
    assert (found.kind, found.time, found.boots) == ("ResponsePDU", 10, 1)
    assert int(found.values[0].getComponent().getComponent()) == 1000
    assert agent.counters.not_in_time_windows == 1  # of signing in
