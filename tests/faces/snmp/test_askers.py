"""Messages of known askers: opened as by the long way, or left to it; what is remembered is bounded."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pysnmp.proto.api import v2c

from gateway.faces.snmp import reader, v3, wire
from gateway.faces.snmp.agent import SnmpAgent
from gateway.faces.snmp.askers import MOST_ASKERS
from gateway.faces.snmp.security import Security
from gateway.faces.snmp.usm import Auth, Priv
from tests.faces.snmp.poller import AUTH_PRIV, Poller, a_user, credentials, pdu
from tests.faces.snmp.stub_site import StubClock
from tests.faces.snmp.test_responder import LOCAL, SYS_DESCR

USERS = (a_user("noc"), a_user("other", Auth.SHA_512, Priv.AES_256))
NAMES = {each.credentials.name for each in USERS}


@pytest.fixture
def secured(make_agent: Callable[..., SnmpAgent]) -> SnmpAgent:
    agent = make_agent(users=USERS)
    agent.prepare()
    return agent


def security(agent: SnmpAgent) -> Security:
    found = agent._responder.security
    assert found is not None
    return found


def signed_in(agent: SnmpAgent, name: str = "noc") -> Poller:
    user = next(each for each in USERS if each.credentials.name == name.encode())
    poller = Poller(lambda data: agent.answer(data, LOCAL), user.credentials)
    poller.sign_in()
    assert poller.ask(v2c.GetRequestPDU, SYS_DESCR) is not None
    return poller


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=100)
@given(
    name=st.sampled_from(["noc", "other"]),
    size=st.integers(0, 700),
    message_id=st.integers(0, 2**31 - 1),
    flags=st.sampled_from([AUTH_PRIV, v3.AUTH | v3.PRIV]),
)
def test_both_ways_open_the_same(
    secured: SnmpAgent, clock: StubClock, *, name: str, size: int, message_id: int, flags: int
) -> None:
    poller = signed_in(secured, name)
    poller.message_id = message_id - 1
    data = poller.sealed(wire.tlv(reader.GET, bytes(size)), flags)
    message = v3.parse(data, reader.version(data)[2])
    right = security(secured).open(message, NAMES, clock.now)
    quick = security(secured).open_known(data, NAMES, clock.now)
    assert quick is not None
    for field in ("user", "message_id", "flags", "plain", "context", "pdu_at", "room"):
        assert getattr(quick, field) == getattr(right, field), field


def test_an_unknown_asker_takes_the_long_way(secured: SnmpAgent, clock: StubClock) -> None:
    poller = signed_in(secured)
    body = pdu(v2c.GetRequestPDU, SYS_DESCR)

    def known(data: bytes, names: set[bytes] = NAMES) -> bool:
        return security(secured).open_known(data, names, clock.now) is not None

    assert known(poller.sealed(body))
    assert not known(poller.sealed(body), {b"other"})  # not from this address
    assert not known(poller.sealed(body, v3.AUTH | v3.PRIV))  # not said before: wants no report
    poller.max_size = 500
    assert not known(poller.sealed(body))
    poller.max_size = v3.OWN_MAX_SIZE
    poller.context = b"elsewhere"
    assert not known(poller.sealed(body))
    poller.context = b""
    later = poller.sealed(body)
    clock.now += 150
    assert known(later)
    clock.now += 1
    assert not known(later)


def test_a_stretch_of_one_user_with_the_key_of_another_is_nobodys(secured: SnmpAgent, clock: StubClock) -> None:
    poller, other = signed_in(secured), signed_in(secured, "other")
    assert poller.user is not None
    assert other.user is not None
    poller.user.mac = other.user.mac
    data = poller.sealed(pdu(v2c.GetRequestPDU, SYS_DESCR))
    assert security(secured).open_known(data, NAMES, clock.now) is None
    assert poller.exchange(data) is not None  # the report of the long way
    assert secured.counters.wrong_digests == 1


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=200)
@given(data=st.data())
def test_cut_and_changed_messages_are_not_opened(secured: SnmpAgent, clock: StubClock, data: st.DataObject) -> None:
    message = signed_in(secured).sealed(pdu(v2c.GetRequestPDU, SYS_DESCR))
    at = data.draw(st.integers(0, len(message) - 1))
    octets = data.draw(st.binary(max_size=3))
    changed = message[:at] + octets + message[at + data.draw(st.integers(0, 3)) :]
    if changed != message:
        assert security(secured).open_known(changed, NAMES, clock.now) is None


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=150)
@given(data=st.data())
def test_authentic_but_odd_messages_are_opened_as_by_the_long_way_or_left_to_it(
    secured: SnmpAgent, clock: StubClock, data: st.DataObject
) -> None:
    """A user may send what he likes, well signed: lengths in more octets than needed, other tags, other sizes."""
    poller = signed_in(secured)
    message = bytearray(poller.sealed(pdu(v2c.GetRequestPDU, SYS_DESCR)))
    mac_at = v3.parse(bytes(message), reader.version(bytes(message))[2]).mac_at
    assert poller.user is not None
    mac = poller.user.mac
    for _ in range(data.draw(st.integers(1, 2))):
        at = data.draw(st.integers(0, len(message) - 1).filter(lambda at: not mac_at <= at < mac_at + mac.size))
        message[at] = data.draw(st.one_of(st.integers(0, 255), st.sampled_from([message[at] + 1 & 255, 0x81, 0x30])))
    message[mac_at : mac_at + mac.size] = mac.blank
    message[mac_at : mac_at + mac.size] = mac.of(bytes(message))
    signed = bytes(message)
    quick = security(secured).open_known(signed, NAMES, clock.now)
    if quick is None:
        return
    right = security(secured).open(v3.parse(signed, reader.version(signed)[2]), NAMES, clock.now)
    for field in ("user", "message_id", "flags", "plain", "context", "pdu_at", "room"):
        assert getattr(quick, field) == getattr(right, field), field


def test_what_is_remembered_is_bounded_and_the_newest_stays(secured: SnmpAgent, clock: StubClock) -> None:
    poller = signed_in(secured)
    known = security(secured)._askers._known
    for second in range(2 * MOST_ASKERS):
        clock.now += 1
        poller.authority = poller.authority._replace(time=second + 1)
        assert poller.ask(v2c.GetRequestPDU, SYS_DESCR) is not None
    assert len(known) == MOST_ASKERS
    assert security(secured).open_known(poller.sealed(pdu(v2c.GetRequestPDU)), NAMES, clock.now) is not None


def test_only_what_passed_is_remembered(secured: SnmpAgent) -> None:
    poller = Poller(lambda data: secured.answer(data, LOCAL), credentials(phrases=("not the phrase", "private phrase")))
    poller.sign_in()
    assert poller.exchange(poller.sealed(pdu(v2c.GetRequestPDU, SYS_DESCR))) is not None
    assert security(secured)._askers._known == {}
