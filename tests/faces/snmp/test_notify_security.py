"""The way of informs and traps through SNMPv3, and what a stranger's answers can do: nothing."""

from __future__ import annotations

import contextlib
import copy

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.faces.snmp import notify_security, reader, v3, wire
from gateway.faces.snmp.counters import SnmpCounters
from gateway.faces.snmp.engine import Engine
from gateway.faces.snmp.notify_pdu import INFORM
from gateway.faces.snmp.notify_security import CommunityChannel, Heard, InformChannel, TrapChannel
from gateway.faces.snmp.reader import NotSnmp
from gateway.faces.snmp.secret import Secret
from gateway.faces.snmp.security import Rejected, Security
from gateway.faces.snmp.usm import Credentials, LocalUser
from tests.faces.snmp.poller import credentials

ENGINE_ID = b"\x80\x00\x00\x00\x05receiver"
REQUEST = 4711


def pdu(kind: int, request_id: int = REQUEST) -> bytes:
    return wire.tlv(kind, wire.integer(0x02, request_id) + wire.integer(0x02, 0) * 2 + wire.tlv(0x30, b""))


class Receiver:
    """A receiver of informs: our own engine's side of SNMPv3, with a Response to whatever it accepts."""

    def __init__(self, engine_id: bytes = ENGINE_ID, boots: int = 7, started_at: float = -1000.0) -> None:
        self.engine = Engine(engine_id, boots, started_at)
        self.security = Security(self.engine, [credentials()], SnmpCounters(), 1400)
        self.got: list[bytes] = []

    def take(self, data: bytes, now: float) -> bytes:
        message = v3.parse(data, reader.version(data)[2])
        try:
            opened = self.security.open(message, {b"noc"}, now)
        except Rejected as rejected:
            return rejected.report
        body = opened.plain[opened.pdu_at :]
        self.got.append(body)
        return self.security.reply(opened, pdu(wire.RESPONSE), now)


def signed_in(receiver: Receiver, now: float = 0.0) -> tuple[InformChannel, bytes]:
    """A channel that knows the receiver, and the receiver's answer to its inform."""
    channel = InformChannel(credentials())
    for _ in range(2):
        report = receiver.take(channel.seal(REQUEST, pdu(INFORM), now), now)
        assert channel.heard(report, now) == Heard(REQUEST, again=True)
    return channel, receiver.take(channel.seal(REQUEST, pdu(INFORM), now), now)


def test_the_receiver_is_asked_who_it_is_and_what_time_it_has() -> None:
    receiver = Receiver()
    channel, answer = signed_in(receiver)
    assert receiver.got == [pdu(INFORM)]
    assert channel.heard(answer, 0.0) == Heard(REQUEST, acknowledged=True)


def test_its_time_goes_on() -> None:
    receiver = Receiver()
    channel, answer = signed_in(receiver)
    channel.heard(answer, 0.0)
    answer = receiver.take(channel.seal(REQUEST, pdu(INFORM), 86400.0), 86400.0)
    assert channel.heard(answer, 86400.0) == Heard(REQUEST, acknowledged=True)


@pytest.mark.parametrize("engine_id", [ENGINE_ID, b"\x80\x00\x00\x00\x05another"])
def test_a_receiver_that_was_started_again_is_learned_again(engine_id: bytes) -> None:
    channel, answer = signed_in(Receiver())
    channel.heard(answer, 0.0)
    again = Receiver(engine_id, boots=8, started_at=100.0)
    answers = []
    for _ in range(3):
        heard = channel.heard(again.take(channel.seal(REQUEST, pdu(INFORM), 101.0), 101.0), 101.0)
        assert heard is not None
        answers.append(heard)
        if heard.acknowledged:
            break
    assert answers[-1] == Heard(REQUEST, acknowledged=True)
    assert all(each.again for each in answers[:-1])


def test_an_answer_counts_once_and_only_to_what_was_sent() -> None:
    channel, answer = signed_in(Receiver())
    other = InformChannel(credentials())
    assert other.heard(answer, 0.0) is None
    assert channel.heard(answer, 0.0) == Heard(REQUEST, acknowledged=True)
    assert channel.heard(answer, 0.0) is None


@pytest.mark.parametrize("place", ["mac", "body", "engine", "user"])
def test_a_changed_answer_is_nothing(place: str) -> None:
    channel, answer = signed_in(Receiver())
    message = v3.parse(answer, reader.version(answer)[2])
    at = {
        "mac": message.mac_at,
        "body": message.body_at + 9,
        "engine": answer.index(ENGINE_ID) + 8,
        "user": answer.index(b"noc"),
    }[place]
    changed = answer[:at] + bytes((answer[at] ^ 1,)) + answer[at + 1 :]
    assert channel.heard(changed, 0.0) is None
    assert channel.heard(answer, 0.0) == Heard(REQUEST, acknowledged=True)


def test_an_old_answer_is_nothing() -> None:
    receiver = Receiver()
    channel, answer = signed_in(receiver)
    assert channel.heard(answer, 151.0 + 1) is None


def test_no_more_message_ids_are_kept_than_are_of_use() -> None:
    channel = InformChannel(credentials())
    for request_id in range(1000):
        channel.seal(request_id, pdu(INFORM), 0.0)
    assert len(channel._outstanding) <= 64


def test_a_report_in_clear_teaches_an_engine_id_and_nothing_else() -> None:
    receiver = Receiver()
    channel, _ = signed_in(receiver)
    question = channel.seal(REQUEST, pdu(INFORM), 0.0)
    message = v3.parse(question, reader.version(question)[2])
    report = wire.tlv(
        wire.REPORT,
        wire.integer(0x02, 0) * 3 + wire.tlv(0x30, wire.counter((1, 3, 6, 1, 6, 3, 15, 1, 1, 5, 0), 1)),
    )
    clear = v3.Sealer(None)
    body = v3.scoped(ENGINE_ID, b"", report)
    forged = clear.seal(v3.Authority(ENGINE_ID, 9999, 9999), message.message_id, 0, body)
    assert channel.heard(forged, 0.0) == Heard(REQUEST, refused="digest")
    for odd in (b"", b"x", bytes(33)):
        unknown = wire.tlv(
            wire.REPORT,
            wire.integer(0x02, 0) * 3 + wire.tlv(0x30, wire.counter((1, 3, 6, 1, 6, 3, 15, 1, 1, 4, 0), 1)),
        )
        forged = clear.seal(v3.Authority(odd, 1, 1), message.message_id, 0, v3.scoped(odd, b"", unknown))
        assert channel.heard(forged, 0.0) is None
    answer = receiver.take(channel.seal(REQUEST, pdu(INFORM), 0.0), 0.0)
    assert channel.heard(answer, 0.0) == Heard(REQUEST, acknowledged=True)


def test_a_message_of_ours_teaches_one_engine_id(monkeypatch: pytest.MonkeyPatch) -> None:
    """It costs the loop milliseconds to learn one, so who is told of one thing cannot have us learn without end."""
    learned: list[bytes] = []

    def make(secret: Credentials, engine_id: bytes) -> LocalUser:
        learned.append(engine_id)
        return LocalUser(secret, engine_id)

    monkeypatch.setattr(notify_security, "LocalUser", make)
    channel = InformChannel(credentials())
    question = channel.seal(REQUEST, pdu(INFORM), 0.0)
    engine_ids = [b"\x80\x00\x00\x00\x05%d" % number for number in range(20)]
    for engine_id in engine_ids:
        channel.heard(Receiver(engine_id).take(question, 0.0), 0.0)
    assert learned == engine_ids[:1]


def test_an_inform_by_community_is_acknowledged_by_a_response_of_that_community() -> None:
    channel = CommunityChannel(Secret(b"c0mmunity"))
    sent = channel.seal(REQUEST, pdu(INFORM), 0.0)
    assert reader.community(sent, reader.version(sent)[2])[0] == b"c0mmunity"

    def answer(community: bytes, kind: int, version: int = 1) -> bytes:
        return wire.tlv(0x30, wire.integer(0x02, version) + wire.tlv(0x04, community) + pdu(kind))

    assert channel.heard(answer(b"c0mmunity", wire.RESPONSE), 0.0) == Heard(REQUEST, acknowledged=True)
    assert channel.heard(answer(b"other", wire.RESPONSE), 0.0) is None
    assert channel.heard(answer(b"c0mmunity", INFORM), 0.0) is None
    assert channel.heard(answer(b"c0mmunity", wire.RESPONSE, 0), 0.0) is None


def test_a_trap_is_of_our_own_engine_and_its_boots() -> None:
    engine = Engine(b"\x80\x00\x00\x00\x05ourselves", 3, 100.0)
    channel = TrapChannel(credentials(), engine)
    data = channel.seal(REQUEST, pdu(0xA7), 160.5)
    message = v3.parse(data, reader.version(data)[2])
    assert (message.engine_id, message.boots, message.time) == (engine.engine_id, 3, 60)
    assert message.flags == v3.AUTH | v3.PRIV
    opened = Security(engine, [credentials()], SnmpCounters(), 1400).open(message, {b"noc"}, 160.5)
    assert opened.plain[opened.pdu_at :] == pdu(0xA7)
    assert channel.heard(data, 160.5) is None


VALID = signed_in(Receiver())


@given(st.data())
def test_no_answer_whatever_it_is_does_more_than_to_be_refused(data: st.DataObject) -> None:
    channel, answer = copy.copy(VALID[0]), VALID[1]
    channel._outstanding = dict(channel._outstanding)
    how = data.draw(st.sampled_from(["random", "cut", "changed"]))
    if how == "random":
        odd = data.draw(st.binary(max_size=200))
    elif how == "cut":
        odd = answer[: data.draw(st.integers(0, len(answer) - 1))]
    else:
        at = data.draw(st.integers(0, len(answer) - 1))
        odd = answer[:at] + bytes((data.draw(st.integers(0, 255)),)) + answer[at + 1 :]
    for each in (channel, CommunityChannel(Secret(b"c"))):
        with contextlib.suppress(NotSnmp):
            heard = each.heard(odd, 0.0)
            assert heard is None or odd == answer or heard.again or not heard.acknowledged
