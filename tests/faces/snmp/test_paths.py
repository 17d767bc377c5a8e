"""The quick ways and the long one give the same bytes; our reader and pysnmp's read the same request."""

from __future__ import annotations

import asyncio
import warnings
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pysnmp.proto.api import v2c

from gateway.faces.snmp import reader
from gateway.faces.snmp.agent import SnmpAgent
from gateway.faces.snmp.reader import NotSnmp, Unusual
from gateway.faces.snmp.settings import Oid
from gateway.faces.snmp.usm import Auth, Priv
from tests.faces.snmp.poller import AUTH_PHRASE, PRIV_PHRASE, a_user, pdu
from tests.faces.snmp.stub_site import StubClock, listening
from tests.faces.snmp.test_responder import LIVE, LOCAL, SYS_DESCR, SYS_UP_TIME, request

KINDS = (v2c.GetRequestPDU, v2c.GetNextRequestPDU, v2c.GetBulkRequestPDU)
ARCS = st.one_of(st.integers(0, 200), st.integers(0, 2**32 - 1))
OIDS = st.tuples(st.integers(0, 1), st.integers(0, 39), st.lists(ARCS, max_size=20)).map(
    lambda parts: (parts[0], parts[1], *parts[2])
)
ASKED = st.sampled_from(
    [
        SYS_DESCR,
        SYS_UP_TIME,
        (1, 3),
        (2, 5),
        (*LIVE, 9),
        (*LIVE, 9, 11),
        (*LIVE, 9, 12),
        (*LIVE, 9, 21),
        (*LIVE, 10, 11),
        (*LIVE, 900, 11),
        (*LIVE[:-2], 3, 1, 12, 11),
        (1, 3, 6, 1, 6, 3, 1),
    ]
)
fixed = settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=150)


@given(
    st.sampled_from(KINDS),
    st.lists(OIDS, max_size=12),
    st.integers(-(2**31) + 1, 2**31 - 1),  # the least one is padded by pyasn1: for the slow path
    st.tuples(st.integers(0, 2**31 - 1), st.integers(0, 2**31 - 1)),
)
def test_what_pollers_send_is_read_as_pysnmp_reads_it(
    kind: type, names: list[Oid], request_id: int, bulk: tuple[int, int]
) -> None:
    data = pdu(kind, *names, bulk=bulk, request_id=request_id)
    plain, odd = reader.plain_request(data, 0), reader.odd_request(data, 0, reader.VERSION_2C)
    assert odd is not None
    assert [reader.oid(name) for name in plain.names] == names
    for field in ("kind", "first", "second", "names", "varbinds"):
        assert getattr(plain, field) == getattr(odd, field), field
    # The id stays as it came, which pyasn1 may have padded; its value is the same.
    read = [reader.integer(each.request_id, 0, len(each.request_id))[0] for each in (plain, odd)]
    assert read == [request_id, request_id]


@given(st.sampled_from(KINDS), st.lists(OIDS, max_size=3), st.data())
def test_what_our_reader_takes_pysnmp_takes_and_means_the_same(
    kind: type, names: list[Oid], data: st.DataObject
) -> None:
    mutated = bytearray(pdu(kind, *names))
    for _ in range(data.draw(st.integers(1, 3))):
        mutated[data.draw(st.integers(0, len(mutated) - 1))] = data.draw(st.integers(0, 255))
    try:
        plain = reader.plain_request(bytes(mutated), 0)
        plain_names = [reader.oid(name) for name in plain.names]
    except (Unusual, NotSnmp):
        return
    odd = reader.odd_request(bytes(mutated), 0, reader.VERSION_2C)
    assert odd is not None
    assert (plain.kind, plain.first, plain.second) == (odd.kind, odd.first, odd.second)
    assert plain_names == [reader.oid(name) for name in odd.names]


def test_a_clock_is_never_answered_from_memory(agent: SnmpAgent, clock: StubClock) -> None:
    data = request(v2c.GetBulkRequestPDU, SYS_DESCR, bulk=(0, 3))
    seen = set()
    for _ in range(3):
        clock.now += 1
        reply = agent._responder.again(data, LOCAL, clock.now) or agent.answer(data, LOCAL)
        seen.add(bytes(reply or b""))
    assert len(seen) == 3


@pytest.mark.parametrize("auth", [Auth.SHA_256, Auth.SHA_512])
@pytest.mark.parametrize("priv", [Priv.AES_128, Priv.AES_256])
@pytest.mark.filterwarnings("ignore")  # pysnmp uses ciphers by names that `cryptography` has moved
async def test_pysnmp_as_a_poller_reads_the_same_by_v3_as_by_v2c(
    make_agent: Callable[..., SnmpAgent], auth: Auth, priv: Priv
) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from pysnmp.hlapi.v3arch import asyncio as hlapi
    auths = {Auth.SHA_256: hlapi.usmHMAC192SHA256AuthProtocol, Auth.SHA_512: hlapi.usmHMAC384SHA512AuthProtocol}
    privs = {Priv.AES_128: hlapi.usmAesCfb128Protocol, Priv.AES_256: hlapi.usmAesCfb256Protocol}
    user = hlapi.UsmUserData("noc", AUTH_PHRASE, PRIV_PHRASE, authProtocol=auths[auth], privProtocol=privs[priv])
    agent = make_agent(users=(a_user(auth=auth, priv=priv),))
    async with listening(agent) as bound:
        engine = hlapi.SnmpEngine()
        target = await hlapi.UdpTransportTarget.create(bound, timeout=60, retries=0)

        async def bulk(credential: Any) -> list[tuple[Oid, bytes]]:
            names = [hlapi.ObjectType(hlapi.ObjectIdentity(each)) for each in ((*LIVE, 8), (*LIVE, 20))]
            failed, status, _, pairs = await asyncio.wait_for(
                hlapi.bulk_cmd(engine, credential, target, hlapi.ContextData(), 0, 12, *names, lookupMib=False), 20
            )
            assert (failed, int(status)) == (None, 0)
            return [(tuple(name), bytes(str(value), "utf8")) for name, value in pairs]

        secure, plain = await bulk(user), await bulk(hlapi.CommunityData("public"))
        assert secure == plain
        assert len(secure) == 24
        engine.close_dispatcher()
