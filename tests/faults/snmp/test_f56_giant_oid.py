"""F56: OIDs of thousands of octets (CVE-2026-23490): too long a datagram is dropped unread, the rest is bounded."""

from __future__ import annotations

import time
import tracemalloc
from importlib.metadata import version

import pytest

from gateway.faces.snmp.agent import SnmpAgent
from gateway.faces.snmp.responder import DATAGRAM_LIMIT
from tests.faces.snmp.test_responder import LOCAL


def get(oid_content: bytes) -> bytes:
    """A v2c GET of "public" of one OID."""

    def tlv(tag: int, content: bytes) -> bytes:
        return bytes((tag, 0x82)) + len(content).to_bytes(2) + content

    pdu = b"\x02\x01\x01\x02\x01\x00\x02\x01\x00" + tlv(0x30, tlv(0x30, tlv(0x06, oid_content) + b"\x05\x00"))
    return tlv(0x30, b"\x02\x01\x01\x04\x06public" + tlv(0xA0, pdu))


def test_pyasn1_is_new_enough() -> None:
    assert tuple(int(part) for part in version("pyasn1").split(".")[:3]) >= (0, 6, 4)


@pytest.mark.parametrize("octet", [b"\xff", b"\x80", b"\x81", b"\x2b"])
@pytest.mark.parametrize("octets", [100, 600, 1400, 5000, 60000])
def test_it_is_dropped_soon_and_takes_no_memory(agent: SnmpAgent, octet: bytes, octets: int) -> None:
    data = get(octet * octets + b"\x01")
    agent.answer(get(b"\x2b" * 1300), LOCAL)  # what is imported or made once
    tracemalloc.start()
    before = time.thread_time()
    reply = agent.answer(data, LOCAL)
    spent = time.thread_time() - before
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    if octet == b"\x2b" and octets == 100:
        assert reply is not None  # 102 arcs are an OID; there is just nothing there
        return
    assert reply is None
    assert spent < 0.1
    assert peak < 1 << 20
    counted = agent.counters.oversized if len(data) > DATAGRAM_LIMIT else agent.counters.parse_errors
    assert counted >= 1
