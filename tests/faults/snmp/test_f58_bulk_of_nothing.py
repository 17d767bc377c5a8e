"""F58: GETBULK with 0 repetitions, or without names has a valid, empty answer."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from pysnmp.proto.api import v2c

from gateway.faces.snmp.agent import SnmpAgent
from tests.faces.snmp.poller import Poller, a_user
from tests.faces.snmp.test_responder import LOCAL, SYS_DESCR, Reply, request


@pytest.mark.parametrize(
    ("names", "bulk"),
    [
        ((), (0, 0)),
        ((), (0, 10)),
        ((), (5, 0)),
        ((SYS_DESCR,), (0, 0)),
        ((SYS_DESCR, SYS_DESCR), (0, 0)),
    ],
)
def test_it_is_answered(
    make_agent: Callable[..., SnmpAgent], names: tuple[tuple[int, ...], ...], bulk: tuple[int, int]
) -> None:
    agent = make_agent(users=(a_user(),))
    agent.prepare()
    poller = Poller(lambda data: agent.answer(data, LOCAL))
    poller.sign_in()
    plain = Reply(agent.answer(request(v2c.GetBulkRequestPDU, *names, bulk=bulk), LOCAL) or b"")
    secure = poller.ask(v2c.GetBulkRequestPDU, *names, bulk=bulk)
    assert secure is not None
    assert (plain.status, plain.index, plain.names) == (0, 0, [])
    assert (secure.kind, secure.status, secure.names) == ("ResponsePDU", 0, [])
    assert agent.counters.internal_errors == 0
