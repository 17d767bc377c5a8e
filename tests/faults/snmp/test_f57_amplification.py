"""F57: GETBULK with 2³¹-1 repetitions and many names: a bounded reply, a bounded rate, nothing without a credential."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from pysnmp.proto.api import v2c

from gateway.faces.snmp.agent import SnmpAgent
from gateway.faces.snmp.settings import REPLY_LIMIT, SnmpSettings
from tests.faces.snmp.poller import Poller, a_user, pdu
from tests.faces.snmp.stub_site import StubClock
from tests.faces.snmp.test_responder import LIVE, LOCAL, Reply, request

MOST = 2**31 - 1


@pytest.mark.parametrize("names", [1, 60])
@pytest.mark.parametrize("limit", [484, REPLY_LIMIT])
def test_a_reply_is_never_longer_than_the_limit(make_agent: Callable[..., SnmpAgent], names: int, limit: int) -> None:
    agent = make_agent(reply_octets=limit)
    data = request(v2c.GetBulkRequestPDU, *[(*LIVE, 8)] * names, bulk=(0, MOST))
    for _ in range(2):
        reply = agent.answer(data, LOCAL)
        assert reply is not None
        assert len(reply) <= limit
        assert len(Reply(reply).names) > 5


@pytest.mark.parametrize("max_size", [484, 700, 65507])
def test_a_v3_reply_is_never_longer_than_the_asker_takes(make_agent: Callable[..., SnmpAgent], max_size: int) -> None:
    agent = make_agent(users=(a_user(),))
    agent.prepare()
    poller = Poller(lambda data: agent.answer(data, LOCAL))
    poller.sign_in()
    poller.max_size = max_size
    read = poller.ask(v2c.GetBulkRequestPDU, (*LIVE, 8), bulk=(0, MOST))
    assert read is not None
    assert read.status == 0
    assert len(read.names) >= 1
    whole = poller.exchange(poller.sealed(pdu(v2c.GetBulkRequestPDU, (*LIVE, 8), bulk=(0, MOST))))
    assert whole is not None
    assert len(whole) <= min(max_size, REPLY_LIMIT)
    assert len(whole) > min(max_size, REPLY_LIMIT) - 170
    many = poller.ask(v2c.GetRequestPDU, *[(*LIVE, 9, 11)] * 40)
    assert many is not None
    assert (many.status, len(many.names)) == ((1, 0) if max_size < REPLY_LIMIT else (0, 40))  # tooBig


def test_a_source_that_asks_too_much_is_not_answered_for_a_while(
    make_agent: Callable[..., SnmpAgent], clock: StubClock, caplog: pytest.LogCaptureFixture
) -> None:
    agent = make_agent(requests_per_s=10.0)
    data = request(v2c.GetBulkRequestPDU, (1, 3), bulk=(0, MOST))
    answered = sum(agent.answer(data, LOCAL) is not None for _ in range(1000))
    assert answered == 100
    assert agent.counters.rate_limited == 900
    assert agent.answer(data, "127.0.0.2") is not None  # others are not affected
    clock.now += 1
    assert sum(agent.answer(data, LOCAL) is not None for _ in range(1000)) == 10
    assert sum("reason=rate" in record.getMessage() for record in caplog.records) == 1


def test_nobody_can_ask_by_v2c_unless_a_community_says_so() -> None:
    assert SnmpSettings().communities == ()
