"""RFC 3416 on bytes: requests built with pysnmp, replies read with pysnmp, hostile datagrams by hypothesis."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from ipaddress import ip_network
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pyasn1.codec.ber import decoder, encoder
from pysnmp.proto import rfc1901
from pysnmp.proto.api import v2c

from gateway.core.site import Device, Site
from gateway.faces.snmp import reader
from gateway.faces.snmp.agent import SnmpAgent
from gateway.faces.snmp.reader import MOST_ODD
from gateway.faces.snmp.responder import DATAGRAM_LIMIT, ODD_OCTETS, Refusal, Refused
from gateway.faces.snmp.settings import REPLY_LIMIT, Community, Oid
from tests.faces.snmp.stub_site import StubClock

LOCAL = "127.0.0.1"
SYS_DESCR = (1, 3, 6, 1, 2, 1, 1, 1, 0)
SYS_UP_TIME = (1, 3, 6, 1, 2, 1, 1, 3, 0)
SYS_SERVICES = (1, 3, 6, 1, 2, 1, 1, 7, 0)
LIVE = (1, 3, 6, 1, 4, 1, 32473, 1, 1, 2, 1, 4, 1)
END = (2, 0)

NOT_WRITABLE, TOO_BIG = 17, 1


def request(
    kind: type, *names: Oid, community: bytes = b"public", bulk: tuple[int, int] = (0, 10), value: object = None
) -> bytes:
    message, pdu = v2c.Message(), kind()
    v2c.apiMessage.set_defaults(message)
    v2c.apiMessage.set_community(message, community)
    if kind is v2c.GetBulkRequestPDU:
        v2c.apiBulkPDU.set_defaults(pdu)
        v2c.apiBulkPDU.set_non_repeaters(pdu, bulk[0])
        v2c.apiBulkPDU.set_max_repetitions(pdu, bulk[1])
    else:
        v2c.apiPDU.set_defaults(pdu)
    v2c.apiPDU.set_varbinds(pdu, [(name, v2c.null if value is None else value) for name in names])
    v2c.apiPDU.set_request_id(pdu, 4711)
    v2c.apiMessage.set_pdu(message, pdu)
    encoded: bytes = encoder.encode(message)
    return encoded


@dataclass
class Reply:
    data: bytes

    def __post_init__(self) -> None:
        message, rest = decoder.decode(self.data, asn1Spec=rfc1901.Message())
        assert rest == b""
        pdu = message[2].getComponent()
        assert int(pdu[0]) == 4711
        self.status, self.index = int(pdu[1]), int(pdu[2])
        self.names: list[Oid] = [tuple(pair[0]) for pair in pdu[3]]
        self.values: list[Any] = [pair[1].getComponent() for pair in pdu[3]]

    def kinds(self) -> list[str]:
        return [type(value).__name__ for value in self.values]


Answer = Callable[[bytes], Reply]


@pytest.fixture
def answer(agent: SnmpAgent, clock: StubClock) -> Answer:
    return lambda data: Reply(agent._responder.answer(data, LOCAL, clock.now))


def test_get_answers_in_the_order_asked(answer: Answer) -> None:
    names = [SYS_SERVICES, SYS_DESCR, (*LIVE, 9, 11)]
    reply = answer(request(v2c.GetRequestPDU, *names))
    assert (reply.status, reply.index) == (0, 0)
    assert reply.names == names


def test_what_only_pysnmp_can_read_uses_up_the_allowance_by_its_length(
    make_agent: Callable[..., SnmpAgent], clock: StubClock
) -> None:
    """It takes milliseconds, and so a poller of odd requests would have the event loop to itself."""

    def answered(data: bytes) -> int:
        agent = make_agent(requests_per_s=10.0)  # and ten seconds' worth at once
        count = 0
        while agent.answer(data, LOCAL) is not None:
            count += 1
        assert agent.counters.rate_limited == 1
        return count

    names = [(1, 3)] * MOST_ODD
    plain, odd = request(v2c.GetRequestPDU, *names), request(v2c.GetRequestPDU, *names, value=v2c.Integer(0))
    assert answered(plain) == 100
    assert answered(odd) == math.ceil(100 / (1 + len(odd) / ODD_OCTETS)) == 8
    agent = make_agent(requests_per_s=10.0)
    for _ in range(8):
        assert agent.answer(odd, LOCAL) is not None
    clock.now += 100.0
    assert agent.answer(plain, LOCAL) is not None, "it comes back with time"


@pytest.mark.parametrize("kind", [v2c.GetRequestPDU, v2c.GetNextRequestPDU, v2c.GetBulkRequestPDU, v2c.SetRequestPDU])
def test_more_than_pysnmp_can_read_in_a_moment_is_too_big(
    answer: Answer, kind: type, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Who asks so asks for less then, as whoever is told that a reply would be too big (RFC 3416 §4.2.1)."""
    value = v2c.Integer(0)
    assert answer(request(kind, *[END] * MOST_ODD, value=value)).status in {0, NOT_WRITABLE}
    monkeypatch.setattr(reader, "decoder", None)  # which is not asked
    reply = answer(request(kind, *[END] * (MOST_ODD + 1), value=value))
    assert (reply.status, reply.index, reply.names) == (TOO_BIG, 0, [])


def test_too_big_comes_with_what_was_asked_in_version_1(make_agent: Callable[..., SnmpAgent]) -> None:
    asked = bytearray(request(v2c.GetRequestPDU, *[(1, 3)] * (MOST_ODD + 1), value=v2c.Integer(0)))
    asked[asked.index(b"\x02\x01\x01") + 2] = 0
    expected = (
        bytes(asked).replace(b"\xa0\x82", b"\xa2\x82").replace(b"\x02\x01\x00\x02\x01\x00", b"\x02\x01\x01\x02\x01\x00")
    )
    assert make_agent(v1=True).answer(bytes(asked), LOCAL) == expected


def test_get_tells_missing_instances_from_missing_objects(answer: Answer) -> None:
    reply = answer(request(v2c.GetRequestPDU, (*LIVE, 9, 12), (*LIVE, 9, 99), (*LIVE, 900, 11), (1, 3, 6, 1, 6, 3, 1)))
    assert reply.kinds() == ["NoSuchInstance", "NoSuchInstance", "NoSuchObject", "NoSuchObject"]
    assert reply.status == 0


def test_getnext_steps_and_ends(answer: Answer) -> None:
    reply = answer(request(v2c.GetNextRequestPDU, (1, 3), (2, 5), SYS_DESCR, (0, 0)))
    assert reply.names == [SYS_DESCR, (2, 5), (1, 3, 6, 1, 2, 1, 1, 2, 0), SYS_DESCR]
    assert reply.kinds()[1] == "EndOfMibView"


@pytest.mark.parametrize("kind", [v2c.GetRequestPDU, v2c.GetNextRequestPDU, v2c.GetBulkRequestPDU])
def test_a_request_for_nothing_has_an_empty_answer(answer: Answer, kind: type) -> None:
    reply = answer(request(kind))
    assert (reply.status, reply.index, reply.names) == (0, 0, [])


@pytest.mark.parametrize(
    ("bulk", "expected"),
    [
        ((0, 0), []),
        ((1, 0), ["next"]),
        ((5, 7), ["next", "next"]),  # more non-repeaters than names
        ((1, 2), ["next", "next", "next"]),
        ((0, 2), ["next"] * 4),
    ],
)
def test_getbulk_counts_like_rfc_3416(answer: Answer, bulk: tuple[int, int], expected: list[str]) -> None:
    reply = answer(request(v2c.GetBulkRequestPDU, SYS_DESCR, (*LIVE, 8), bulk=bulk))
    assert len(reply.names) == len(expected)
    assert reply.status == 0


def test_getbulk_equals_the_same_steps_by_getnext(answer: Answer) -> None:
    at = [SYS_DESCR, (*LIVE, 8), (1, 3, 6, 1, 2, 1, 11)]
    expected: list[Oid] = list(answer(request(v2c.GetNextRequestPDU, at[0])).names)
    names = at[1:]
    for _ in range(4):
        names = answer(request(v2c.GetNextRequestPDU, *names)).names
        expected += names

    assert answer(request(v2c.GetBulkRequestPDU, *at, bulk=(1, 4))).names == expected


def test_getbulk_stops_after_a_round_of_ends(answer: Answer) -> None:
    reply = answer(request(v2c.GetBulkRequestPDU, (2, 5), (2, 6), bulk=(0, 50)))
    assert reply.names == [(2, 5), (2, 6)]
    assert reply.kinds() == ["EndOfMibView"] * 2


def test_getbulk_over_the_end_repeats_the_last_name(answer: Answer, agent: SnmpAgent) -> None:
    last: Oid = (2, 5)
    at: Oid = (1, 3)
    while (step := agent.tree.after(at, 0.0)) is not None:
        at = last = step[0]
    reply = answer(request(v2c.GetBulkRequestPDU, last[:-1], (1, 3), bulk=(0, 2)))
    assert reply.names[0] == reply.names[2] == last
    assert reply.kinds()[2] == "EndOfMibView"


@pytest.mark.parametrize("names", [[(1, 3)], [(1, 3)] * 60, [(*LIVE, 8), (1, 3, 6, 1, 2, 1, 1, 4)] * 20])
def test_getbulk_fills_the_budget_and_no_more(answer: Answer, names: list[Oid]) -> None:
    reply = answer(request(v2c.GetBulkRequestPDU, *names, bulk=(0, 2**31 - 1)))
    assert reply.status == 0
    assert REPLY_LIMIT - 120 < len(reply.data) <= REPLY_LIMIT


def test_replies_that_cannot_be_cut_are_too_big(answer: Answer) -> None:
    for kind, name in ((v2c.GetRequestPDU, SYS_DESCR), (v2c.GetNextRequestPDU, (1, 3))):
        reply = answer(request(kind, *[name] * 40))
        assert (reply.status, reply.index, reply.names) == (TOO_BIG, 0, [])


def test_a_bulk_request_whose_first_varbind_does_not_fit_is_too_big(
    make_agent: Callable[..., SnmpAgent], clock: StubClock
) -> None:
    long = "c" * 1360
    agent = make_agent(communities=(Community(long, (ip_network("127.0.0.0/8"),)),))
    reply = Reply(
        agent._responder.answer(request(v2c.GetBulkRequestPDU, (1, 3), community=long.encode()), LOCAL, clock.now)
    )
    assert (reply.status, reply.names) == (TOO_BIG, [])


@pytest.mark.parametrize("name", [SYS_DESCR, (1, 3, 6, 1, 2, 1, 1, 4, 0), (*LIVE, 9, 11), (1, 3, 6, 1, 6, 3, 1, 1)])
def test_set_is_never_possible(answer: Answer, agent: SnmpAgent, clock: StubClock, name: Oid) -> None:
    before = agent.tree.get(name, clock.now)
    reply = answer(request(v2c.SetRequestPDU, name, SYS_SERVICES, value=v2c.OctetString(b"mine")))
    assert (reply.status, reply.index) == (NOT_WRITABLE, 1)
    assert reply.names == [name, SYS_SERVICES]
    assert bytes(reply.values[0].getComponent().getComponent()) == b"mine"
    assert agent.tree.get(name, clock.now) == before
    assert agent.counters.bad_community_uses == 1


@pytest.mark.parametrize("kind", [v2c.ResponsePDU, v2c.SNMPv2TrapPDU, v2c.InformRequestPDU, v2c.ReportPDU])
def test_pdus_that_are_no_requests_are_dropped(agent: SnmpAgent, clock: StubClock, kind: type) -> None:
    with pytest.raises(Refused) as refused:
        agent._responder.answer(request(kind, SYS_DESCR), LOCAL, clock.now)
    assert refused.value.refusal is Refusal.PDU_TYPE
    assert agent.counters.silent_drops == 1


@pytest.mark.parametrize("version", [0, 3, 127])
def test_only_version_2c_is_spoken(agent: SnmpAgent, clock: StubClock, version: int) -> None:
    data = bytearray(request(v2c.GetRequestPDU, SYS_DESCR))
    data[data.index(b"\x02\x01\x01") + 2] = version
    with pytest.raises(Refused) as refused:
        agent._responder.answer(bytes(data), LOCAL, clock.now)
    assert refused.value.refusal is Refusal.VERSION
    assert agent.counters.bad_versions == 1


def _raw(pdu_content: bytes) -> bytes:
    """A v2c GET of "public" with any PDU content."""
    body = b"\x02\x01\x01\x04\x06public\xa0\x82" + len(pdu_content).to_bytes(2, "big") + pdu_content
    return b"\x30\x82" + len(body).to_bytes(2, "big") + body


HEAD = b"\x02\x01\x01\x02\x01\x00\x02\x01\x00"


@pytest.mark.parametrize(
    "data",
    [
        _raw(b""),
        _raw(HEAD),
        _raw(HEAD + b"\x30\x03\x30\x01\x06"),
        _raw(HEAD + b"\x30\x06\x30\x04\x06\x00\x05\x00"),  # an OID without arcs
        _raw(
            HEAD + b"\x30\x82\x01\x36\x30\x82\x01\x32\x06\x82\x01\x2c" + b"\xff" * 299 + b"\x01\x05\x00"
        ),  # endless arc
        _raw(HEAD + b"\x30\x81\x89\x30\x81\x86\x06\x81\x81" + b"\x2b" * 129 + b"\x05\x00"),  # 130 arcs
        _raw(HEAD + b"\x30\x0c\x30\x0a\x06\x06\x2b\x90\x80\x80\x80\x00\x05\x00"),  # an arc of 2³²
        _raw(b"\x02\x09\x01" + b"\x00" * 8 + HEAD[3:] + b"\x30\x00"),  # request-id of 65 bits
        _raw(HEAD + b"\x30" * 200),
        _raw(HEAD + b"\x30\x81\xc8" + b"\x30\x03\x06\x01\x2b" * 40).replace(b"\xa0", b"\xa9"),  # no PDU
        _raw(HEAD + b"\x30\x09\x30\x07\x06\x01\x2b\x24\x02\x04\x00"),  # a string of strings (RFC 3417 §8)
        _raw(HEAD + b"\x30\x09\x30\x80\x06\x01\x2b\x05\x00\x00\x00"),  # no length
        _raw(HEAD + b"\x30\x07\x30\x05\x06\x01\x2b\x05\x00\x00"),  # octets behind the list
        _raw(HEAD + b"\x30\x05\x30\x03\x06\x01\x2b"),  # no value
        _raw(b"\x30\x80" * 300),
        _raw(HEAD + b"\x30\x00")[:-1],
        b"\x30\x82",
        b"",
    ],
)
def test_malformed_ber_is_dropped_and_counted(agent: SnmpAgent, clock: StubClock, data: bytes) -> None:
    with pytest.raises(Refused) as refused:
        agent._responder.answer(data, LOCAL, clock.now)
    assert refused.value.refusal is Refusal.MALFORMED
    assert agent.counters.parse_errors == 1


def test_long_datagrams_are_dropped_before_they_are_decoded(agent: SnmpAgent, clock: StubClock) -> None:
    with pytest.raises(Refused) as refused:
        agent._responder.answer(request(v2c.GetRequestPDU, *[SYS_DESCR] * 200), LOCAL, clock.now)
    assert refused.value.refusal is Refusal.OVERSIZED
    assert agent.counters.oversized == 1


def accounted(agent: SnmpAgent, data: bytes, now: float) -> None:
    """The datagram ends in one reply that pysnmp can read, or one counter; nothing else comes out."""
    before = agent.counters.in_packets, agent.counters.responses, agent.counters.dropped
    reply = agent.answer(data, "127.0.0.1")
    counters = agent.counters
    assert counters.in_packets == before[0] + 1
    assert counters.responses + counters.dropped == before[1] + before[2] + 1
    assert counters.internal_errors == 0
    assert (reply is not None) == (counters.responses > before[1])
    if reply is not None:
        assert len(reply) <= REPLY_LIMIT
        decoder.decode(reply, asn1Spec=rfc1901.Message())


WELL_FORMED: Sequence[bytes] = (
    request(v2c.GetRequestPDU, SYS_DESCR, (*LIVE, 9, 11)),
    request(v2c.GetNextRequestPDU, (1, 3)),
    request(v2c.GetBulkRequestPDU, SYS_DESCR, (*LIVE, 8), bulk=(1, 20)),
    request(v2c.SetRequestPDU, SYS_DESCR, value=v2c.OctetString(b"x" * 200)),
)

hostile = settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=300)


@hostile
@given(data=st.binary(max_size=DATAGRAM_LIMIT + 5))
def test_random_datagrams_are_accounted_for(agent: SnmpAgent, clock: StubClock, data: bytes) -> None:
    accounted(agent, data, clock.now)


@hostile
@given(content=st.binary(max_size=200))
def test_random_pdus_of_a_known_community_are_accounted_for(agent: SnmpAgent, clock: StubClock, content: bytes) -> None:
    accounted(agent, _raw(content), clock.now)


@hostile
@given(
    which=st.sampled_from(WELL_FORMED),
    flips=st.lists(st.tuples(st.integers(0, 300), st.integers(0, 255)), min_size=1, max_size=4),
    cut=st.integers(0, 40),
)
def test_mutated_requests_are_accounted_for(
    agent: SnmpAgent, clock: StubClock, which: bytes, flips: list[tuple[int, int]], cut: int
) -> None:
    data = bytearray(which)
    for position, octet in flips:
        data[position % len(data)] = octet
    accounted(agent, bytes(data[: len(data) - cut]), clock.now)


def test_a_defect_of_ours_is_answered_and_counted(
    agent: SnmpAgent, clock: StubClock, site: Site, answer: Answer, monkeypatch: pytest.MonkeyPatch
) -> None:
    device: Device = site.by_unit[11]
    monkeypatch.setattr(device, "stats", None)  # a getter that raises
    reply = answer(request(v2c.GetRequestPDU, (*LIVE[:-2], 3, 1, 15, 11)))
    assert (reply.status, reply.names) == (5, [])
    assert agent.counters.internal_errors == 1


def test_the_first_request_is_quick(make_agent: Callable[..., SnmpAgent], clock: StubClock) -> None:
    agent = make_agent()
    data = request(v2c.GetBulkRequestPDU, (1, 3), bulk=(0, 50))
    before = time.thread_time()
    assert agent.answer(data, "127.0.0.1") is not None
    assert time.thread_time() - before < 0.05
