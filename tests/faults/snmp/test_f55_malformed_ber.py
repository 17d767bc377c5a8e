"""F55: PROTOS-like BER: lengths, tags, huge integers, nesting, truncation. Dropped in silence and counted."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from random import Random

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pysnmp.proto.api import v2c

from gateway.faces.snmp import reader, v3, wire
from gateway.faces.snmp.agent import SnmpAgent
from gateway.faces.snmp.settings import REPLY_LIMIT
from tests.faces.snmp.poller import AUTH_PRIV, Poller, a_user, pdu
from tests.faces.snmp.test_responder import LIVE, LOCAL, SYS_DESCR, request

hostile = settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=200)


@pytest.fixture
def spoken(make_agent: Callable[..., SnmpAgent]) -> SnmpAgent:
    """An agent that speaks all versions."""
    agent = make_agent(users=(a_user(),), v1=True, requests_per_s=1e9)
    agent.prepare()
    return agent


def signed_in(agent: SnmpAgent) -> Poller:
    poller = Poller(lambda data: agent.answer(data, LOCAL))
    poller.sign_in()
    return poller


def tlv(tag: int, content: bytes, length: bytes | None = None) -> bytes:
    return bytes((tag,)) + (bytes((len(content),)) if length is None else length) + content


def hostile_values(random: Random) -> bytes:
    """One value as PROTOS makes them."""
    tag = random.choice((0x02, 0x04, 0x05, 0x06, 0x30, 0x40, 0x41, 0x46, 0x24, 0x1F, 0xA0, 0xFF))
    content = random.choice(
        (
            b"",
            b"\x00",
            b"\xff" * 4,
            b"\x80" * 60,
            b"\x7f" + b"\xff" * 100,
            b"\x30" * 200,
            b"\x30\x80" * 40,
            random.randbytes(20),
        )
    )
    length = random.choice(
        (
            None,
            b"\x80",
            b"\x84\xff\xff\xff\xff",
            b"\x84\x7f\xff\xff\xff",
            b"\x89" + b"\x00" * 8 + b"\x01",
            b"\xff",
            b"\x81\x00",
            b"\x00",
        )
    )
    return tlv(tag, content, length)


def hostile_datagrams(agent: SnmpAgent, count: int) -> Iterator[bytes]:
    """Good messages of all versions with values replaced, cut, repeated or wrapped in others."""
    random = Random(count)
    poller = signed_in(agent)
    good = [
        request(v2c.GetRequestPDU, SYS_DESCR, (*LIVE, 9, 11)),
        request(v2c.GetBulkRequestPDU, SYS_DESCR, (*LIVE, 8), bulk=(1, 20)),
        poller.sealed(pdu(v2c.GetNextRequestPDU, SYS_DESCR)),
        poller.sealed(pdu(v2c.GetRequestPDU, SYS_DESCR), flags=4),
    ]
    for _ in range(count):
        data = random.choice(good)
        at = random.randrange(len(data))
        end = min(len(data), at + random.randrange(8))
        match random.randrange(4):
            case 0:
                yield data[:at] + hostile_values(random) + data[end:]
            case 1:
                yield data[:at]
            case 2:
                # Authentic and well encrypted, and nonsense inside.
                yield poller.sealed(hostile_values(random), AUTH_PRIV)
            case _:
                body = data[:at] + hostile_values(random) + data[end:]
                yield tlv(0x30, body[2:], b"\x82" + len(body[2:]).to_bytes(2))


def test_hostile_datagrams_end_in_one_counter(spoken: SnmpAgent, caplog: pytest.LogCaptureFixture) -> None:
    counters = spoken.counters
    for data in hostile_datagrams(spoken, 3000):
        reply = spoken.answer(data, LOCAL)
        assert counters.in_packets == counters.responses + counters.dropped
        assert reply is None or len(reply) <= REPLY_LIMIT
    assert counters.parse_errors > 500
    assert counters.internal_errors == 0
    assert sum("reason=malformed" in record.getMessage() for record in caplog.records) == 1
    assert spoken.answer(request(v2c.GetRequestPDU, SYS_DESCR), LOCAL) is not None


def test_a_message_without_flags_is_malformed(spoken: SnmpAgent) -> None:
    header = tlv(0x30, wire.integer(0x02, 1) + wire.integer(0x02, 1472) + tlv(0x04, b""))
    assert spoken.answer(tlv(0x30, wire.integer(0x02, reader.VERSION_3) + header), LOCAL) is None
    assert (spoken.counters.parse_errors, spoken.counters.internal_errors) == (1, 0)


@pytest.mark.parametrize("size", [0, 1, 2, 3])
def test_what_a_known_asker_encrypts_may_be_short(spoken: SnmpAgent, size: int) -> None:
    poller = signed_in(spoken)
    assert poller.ask(v2c.GetRequestPDU, SYS_DESCR) is not None  # from now on it is known
    message_id = wire.integer(0x02, poller.message_id + 1)
    data = v3.Sealer(poller.user).seal(poller.authority, message_id, AUTH_PRIV, b"\x30\x01\x04"[:size])
    assert spoken.answer(data, LOCAL) is not None  # the report
    assert (spoken.counters.decryption_errors, spoken.counters.internal_errors) == (1, 0)


@hostile
@given(data=st.data())
def test_no_octet_of_a_v3_message_can_be_changed(spoken: SnmpAgent, data: st.DataObject) -> None:
    poller = signed_in(spoken)
    assert poller.ask(v2c.GetRequestPDU, SYS_DESCR) is not None  # from now on it is known
    message = bytearray(poller.sealed(pdu(v2c.GetRequestPDU, SYS_DESCR)))
    at = data.draw(st.integers(0, len(message) - 1))
    message[at] ^= data.draw(st.integers(1, 255))
    before = spoken.counters.responses
    spoken.answer(bytes(message), LOCAL)
    assert spoken.counters.responses == before
    assert spoken.counters.internal_errors == 0


def test_hostile_datagrams_cost_little_time(spoken: SnmpAgent) -> None:
    datagrams = list(hostile_datagrams(spoken, 1000))
    slowest = 0.0
    for data in datagrams:
        before = time.thread_time()
        spoken.answer(data, LOCAL)
        slowest = max(slowest, time.thread_time() - before)
    assert slowest < 0.05
