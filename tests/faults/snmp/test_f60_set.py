"""F60: SET with every credential and version is refused in the protocol's words, and changes nothing."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from pyasn1.codec.ber import decoder, encoder
from pysnmp.proto import rfc1157
from pysnmp.proto.api import v1, v2c

from gateway.faces.snmp.agent import SnmpAgent
from gateway.faces.snmp.settings import Community, Oid
from tests.faces.snmp.poller import LOOPBACK, Poller, a_user
from tests.faces.snmp.stub_site import StubClock
from tests.faces.snmp.test_responder import LIVE, LOCAL, Reply, request

NOT_WRITABLE, NO_SUCH_NAME = 17, 2
SUBTREES: tuple[Oid, ...] = ((1, 3, 6, 1, 6, 3), (1, 3, 6, 1, 4, 1, 20408), (1, 3, 6, 1, 6))
NAMES: tuple[Oid, ...] = (
    (1, 3, 6, 1, 2, 1, 1, 4, 0),
    (*LIVE, 9, 11),
    (1, 3, 6, 1, 2, 1, 11, 30, 0),
    (1, 3, 6, 1, 6, 3, 1, 1, 6, 1, 0),
    (1, 3, 6, 1, 4, 1, 20408, 3, 1, 1, 1, 2),
)


def v1_message(kind: type, name: Oid) -> bytes:
    pdu = kind()
    v1.apiPDU.set_defaults(pdu)
    v1.apiPDU.set_varbinds(pdu, [(name, v1.OctetString(b"mine") if kind is v1.SetRequestPDU else v1.null)])
    message = v1.Message()
    v1.apiMessage.set_defaults(message)
    v1.apiMessage.set_community(message, b"public")
    v1.apiMessage.set_pdu(message, pdu)
    encoded: bytes = encoder.encode(message)
    return encoded


@pytest.fixture
def open_agent(make_agent: Callable[..., SnmpAgent]) -> SnmpAgent:
    agent = make_agent(
        communities=(Community("public", LOOPBACK), Community("noc", LOOPBACK)),
        users=(a_user("noc"), a_user("other")),
        v1=True,
    )
    agent.prepare()
    return agent


def poller(agent: SnmpAgent, name: str) -> Poller:
    made = Poller(lambda data: agent.answer(data, LOCAL), a_user(name).credentials)
    made.sign_in()
    return made


@pytest.mark.parametrize("name", NAMES)
def test_set_is_refused_and_changes_nothing(open_agent: SnmpAgent, clock: StubClock, name: Oid) -> None:
    before = open_agent.tree.get(name, clock.now)
    for community in (b"public", b"noc"):
        data = request(v2c.SetRequestPDU, name, community=community, value=v2c.OctetString(b"mine"))
        reply = Reply(open_agent.answer(data, LOCAL) or b"")
        assert (reply.status, reply.index, reply.names) == (NOT_WRITABLE, 1, [name])
    for user in ("noc", "other"):
        read = poller(open_agent, user).ask(v2c.SetRequestPDU, name)
        assert read is not None
        assert (read.kind, read.status, read.names) == ("ResponsePDU", NOT_WRITABLE, [name])
    answer = open_agent.answer(v1_message(v1.SetRequestPDU, name), LOCAL)
    message, _ = decoder.decode(answer, asn1Spec=rfc1157.Message())
    pdu = message[2].getComponent()
    assert (int(pdu[1]), int(pdu[2]), tuple(pdu[3][0][0])) == (NO_SUCH_NAME, 1, name)
    assert open_agent.tree.get(name, clock.now) == before
    assert open_agent.counters.bad_community_uses == 5


@pytest.mark.parametrize("subtree", SUBTREES)
def test_nothing_of_pysnmps_engine_is_there_for_any_credential(open_agent: SnmpAgent, subtree: Oid) -> None:
    for community in (b"public", b"noc"):
        data = request(v2c.GetNextRequestPDU, subtree, community=community)
        reply = Reply(open_agent.answer(data, LOCAL) or b"")
        assert reply.kinds() == ["EndOfMibView"] or reply.names[0][: len(subtree)] != subtree
        data = request(v2c.GetBulkRequestPDU, subtree, community=community, bulk=(0, 100))
        bulk = Reply(open_agent.answer(data, LOCAL) or b"")
        assert not any(name[: len(subtree)] == subtree and name != subtree for name in bulk.names)
    for user in ("noc", "other"):
        read = poller(open_agent, user).ask(v2c.GetBulkRequestPDU, subtree, bulk=(0, 100))
        assert read is not None
        assert not any(name[: len(subtree)] == subtree and name != subtree for name in read.names)
    answer = open_agent.answer(v1_message(v1.GetNextRequestPDU, subtree), LOCAL)
    message, _ = decoder.decode(answer, asn1Spec=rfc1157.Message())
    pdu = message[2].getComponent()
    assert int(pdu[1]) == NO_SUCH_NAME or tuple(pdu[3][0][0])[: len(subtree)] != subtree
