"""F59: a wrong community, user, key or level: nothing readable, the counter of RFC 3414 §3.2, one line in the log."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
from pysnmp.proto.api import v2c

from gateway.faces.snmp import v3, wire
from gateway.faces.snmp.agent import SnmpAgent
from gateway.faces.snmp.settings import Community
from gateway.faces.snmp.usm import Auth, Credentials, LocalUser, Priv
from tests.faces.snmp.poller import (
    AUTH_PHRASE,
    AUTH_PRIV,
    LOOPBACK,
    PRIV_PHRASE,
    USM_STATS,
    Poller,
    a_user,
    credentials,
    pdu,
    statistic,
)
from tests.faces.snmp.stub_site import StubClock
from tests.faces.snmp.test_responder import LOCAL, SYS_DESCR, request

WRONG = "quite another one"
LEVEL, WINDOW, USER, ENGINE, DIGEST, DECRYPTION = range(1, 7)
CONTEXT = (1, 3, 6, 1, 6, 3, 12, 1, 5, 0)


@pytest.fixture
def secured(make_agent: Callable[..., SnmpAgent]) -> SnmpAgent:
    agent = make_agent(users=(a_user(), replace(a_user("far"), sources=())))
    agent.prepare()
    return agent


def poller(agent: SnmpAgent, made: Credentials | None = None) -> Poller:
    """A poller that knows engine id and time, and signs in with whatever keys it has."""
    right = Poller(lambda data: agent.answer(data, LOCAL))
    right.sign_in()
    assert right.user is not None
    if made is not None:
        right.user = LocalUser(made, right.authority.engine_id)
    return right


@pytest.mark.parametrize(
    ("made", "statistics", "field"),
    [
        (credentials("nobody"), USER, "unknown_user_names"),
        (credentials("far"), USER, "unknown_user_names"),  # exists, but not from here
        (credentials("NOC"), USER, "unknown_user_names"),
        (credentials(phrases=(WRONG, PRIV_PHRASE)), DIGEST, "wrong_digests"),
        (credentials(auth=Auth.SHA_512), DIGEST, "wrong_digests"),
        (credentials(phrases=(AUTH_PHRASE, WRONG)), DECRYPTION, "decryption_errors"),
        (credentials(priv=Priv.AES_256), DECRYPTION, "decryption_errors"),
    ],
)
def test_wrong_users_and_keys(secured: SnmpAgent, made: Credentials, statistics: int, field: str) -> None:
    asker = poller(secured, made)
    before = getattr(secured.counters, field), secured.counters.responses
    reply = asker.exchange(asker.sealed(pdu(v2c.GetRequestPDU, SYS_DESCR)))
    assert reply is not None
    asker.user = LocalUser(replace(made, name=b"noc", priv_password=credentials().priv_password), asker.authority[0])
    report = asker.read(reply)
    assert statistic(report, (*USM_STATS, statistics, 0)) == before[0] + 1
    assert (getattr(secured.counters, field), secured.counters.responses) == (before[0] + 1, before[1])
    assert not report.flags & v3.PRIV


@pytest.mark.parametrize("flags", [v3.REPORTABLE, v3.REPORTABLE | v3.AUTH])
@pytest.mark.parametrize("kind", [v2c.GetRequestPDU, v2c.GetBulkRequestPDU, v2c.SetRequestPDU])
def test_less_than_auth_priv_is_an_unsupported_level(secured: SnmpAgent, flags: int, kind: type) -> None:
    asker = poller(secured)
    data = asker.sealed(pdu(kind, SYS_DESCR), flags) if flags & v3.AUTH else in_clear(asker, pdu(kind, SYS_DESCR))
    reply = secured.answer(data, LOCAL)
    assert reply is not None
    assert statistic(asker.read(reply), (*USM_STATS, LEVEL, 0)) == 1
    assert secured.counters.responses == 0


def in_clear(asker: Poller, body: bytes) -> bytes:
    """A noAuthNoPriv message that names the user."""
    asker.message_id += 1
    engine_id, boots, engine_time = asker.authority
    fields = [wire.tlv(0x04, engine_id), wire.integer(2, boots), wire.integer(2, engine_time), wire.tlv(0x04, b"noc")]
    security = wire.tlv(0x04, wire.tlv(0x30, b"".join(fields) + wire.tlv(0x04, b"") * 2))
    head = wire.integer(2, asker.message_id) + wire.integer(2, 1472) + wire.tlv(0x04, b"\x04") + wire.integer(2, 3)
    return wire.tlv(0x30, wire.integer(2, 3) + wire.tlv(0x30, head) + security + v3.scoped(engine_id, b"", body))


def test_unknown_engines_contexts_and_context_engines(secured: SnmpAgent) -> None:
    asker = poller(secured)
    right = asker.authority
    asker.authority = right._replace(engine_id=b"\x80\x00\x00\x00\x05other")
    report = asker.ask(v2c.GetRequestPDU, SYS_DESCR)
    assert statistic(report, (*USM_STATS, ENGINE, 0)) == 2  # once by signing in
    asker.authority = right
    asker.context = b"elsewhere"
    found = asker.ask(v2c.GetRequestPDU, SYS_DESCR)
    assert statistic(found, CONTEXT) == 1
    assert found is not None
    assert found.flags == v3.AUTH | v3.PRIV
    asker.context = b""
    reply = asker.exchange(asker.sealed(pdu(v2c.GetRequestPDU, SYS_DESCR), AUTH_PRIV, b"\x80\x00\x00\x00\x05other"))
    assert reply is not None
    assert statistic(asker.read(reply), (1, 3, 6, 1, 6, 3, 11, 2, 1, 3, 0)) == 1
    assert secured.counters.responses == 0


def test_priv_without_auth_and_other_security_models_are_dropped(secured: SnmpAgent) -> None:
    asker = poller(secured)
    data = bytearray(asker.sealed(pdu(v2c.GetRequestPDU, SYS_DESCR)))
    at = data.index(b"\x04\x01\x07") + 2
    data[at] = v3.PRIV | v3.REPORTABLE
    assert secured.answer(bytes(data), LOCAL) is None
    assert secured.counters.invalid_messages == 1
    data[at] = 7
    data[at + 3] = 2
    assert secured.answer(bytes(data), LOCAL) is None
    assert secured.counters.unknown_security_models == 1


def test_who_wants_no_report_gets_none(secured: SnmpAgent) -> None:
    asker = poller(secured, credentials(phrases=(WRONG, PRIV_PHRASE)))
    assert asker.exchange(asker.sealed(pdu(v2c.GetRequestPDU, SYS_DESCR), v3.AUTH | v3.PRIV)) is None
    assert secured.counters.wrong_digests == 1


@pytest.mark.parametrize(
    "community", [b"private", b"Public", b"", b"publi", b"public\0", b"public@11", b"@", b"x" * 200]
)
def test_wrong_communities_get_silence(agent: SnmpAgent, community: bytes) -> None:
    assert agent.answer(request(v2c.GetRequestPDU, SYS_DESCR, community=community), LOCAL) is None
    assert agent.counters.bad_community_names == 1


def test_a_known_request_does_not_open_the_door_for_another_community_or_source(
    make_agent: Callable[..., SnmpAgent],
) -> None:
    """The quick way answers what was asked before; the credential still decides."""
    agent = make_agent(communities=(Community("public", LOOPBACK[:1]), Community("other1", ())))
    right = request(v2c.GetRequestPDU, SYS_DESCR)
    wrong = request(v2c.GetRequestPDU, SYS_DESCR, community=b"other1")
    for _ in range(3):
        assert agent.answer(right, LOCAL) is not None
        assert agent._responder.again(right, LOCAL, 1e6) is not None
        assert agent._responder.again(wrong, LOCAL, 1e6) is None
        assert agent._responder.again(right, "192.0.2.1", 1e6) is None
        assert agent.answer(wrong, LOCAL) is None
        assert agent.answer(right, "192.0.2.1") is None


def test_the_log_says_each_reason_once_and_no_secret(
    secured: SnmpAgent, clock: StubClock, caplog: pytest.LogCaptureFixture
) -> None:
    asker = poller(secured, credentials(phrases=(WRONG, PRIV_PHRASE)))
    failed: list[str] = []
    secured._responder.on_authentication_failure = failed.append
    for _ in range(300):
        asker.exchange(asker.sealed(pdu(v2c.GetRequestPDU, SYS_DESCR)))
        secured.answer(request(v2c.GetRequestPDU, SYS_DESCR, community=b"hunter2hunter2"), LOCAL)
    lines = [record.getMessage() for record in caplog.records if "reason=digest" in record.getMessage()]
    assert lines == ["event=snmp_dropped reason=digest source=127.0.0.1 count=1"]
    assert failed == [LOCAL] * 600
    for secret in (AUTH_PHRASE, PRIV_PHRASE, WRONG, "hunter2"):
        assert secret not in caplog.text
