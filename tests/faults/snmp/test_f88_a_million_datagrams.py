"""F88: a million datagrams; engine ids, users, communities, sources and requests of their own: memory stays flat."""

from __future__ import annotations

import gc
import resource
from collections.abc import Callable
from random import Random

import pytest
from pysnmp.proto.api import v2c

from gateway.faces.snmp import wire
from gateway.faces.snmp.access import SOURCES_KEPT
from gateway.faces.snmp.agent import SnmpAgent
from gateway.faces.snmp.answers import MOST_ANSWERS, MOST_OCTETS
from gateway.faces.snmp.askers import MOST_ASKERS
from gateway.faces.snmp.settings import Oid
from gateway.faces.snmp.singles import MOST_BEGINNINGS
from gateway.faces.snmp.usm import LocalUser
from tests.faces.snmp.poller import Poller, a_user, credentials, pdu
from tests.faces.snmp.stub_site import NOW, StubClock
from tests.faces.snmp.test_responder import LIVE, LOCAL, SYS_DESCR
from tests.faults.snmp.test_f55_malformed_ber import hostile_datagrams

PLATEAU_KIB = 8 * 1024


def peak_kib() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


class Crowd:
    """Everybody who sends something; no two of them the same."""

    def __init__(self, agent: SnmpAgent, clock: StubClock) -> None:
        self._agent = agent
        self._clock = clock
        self._random = Random(1)
        self._right = Poller(lambda data: agent.answer(data, LOCAL))
        self._right.sign_in()
        self._stranger = Poller(lambda _data: None)
        self._stranger.authority = self._right.authority
        self._lost = Poller(lambda _data: None, user=self._right.user)
        self._hostile = list(hostile_datagrams(agent, 2000))
        self._body = pdu(v2c.GetRequestPDU, SYS_DESCR)
        self._keys = LocalUser(credentials("nobody"), self._right.authority.engine_id)

    def send(self, count: int) -> None:
        random, agent = self._random, self._agent
        for number in range(count):
            self._clock.now += 0.01
            self._right.authority = self._right.authority._replace(time=int(self._clock.now - NOW))
            match number % 8:
                case 0:
                    agent.answer(self._hostile[number // 8 % len(self._hostile)], LOCAL)
                case 1:  # an engine id
                    self._lost.authority = self._right.authority._replace(engine_id=random.randbytes(17))
                    agent.answer(self._lost.sealed(self._body, flags=random.choice((4, 7))), LOCAL)
                case 2:  # a user
                    self._keys.name = random.randbytes(8)
                    self._stranger.user = self._keys
                    agent.answer(self._stranger.sealed(self._body), LOCAL)
                case 3:  # a community
                    agent.answer(self._plain(random.randbytes(8), SYS_DESCR), LOCAL)
                case 4:  # a source
                    host = f"10.{number >> 16 & 255}.{number >> 8 & 255}.{number & 255}"
                    agent.answer(self._plain(b"public", SYS_DESCR), host)
                case 5:  # a request that is answered and may be kept
                    names = [(*LIVE, random.randrange(60), random.randrange(30)) for _ in range(4)]
                    agent.answer(self._plain(b"public", *names), LOCAL)
                case 6:  # a request id of another size
                    data = self._plain(
                        b"public", SYS_DESCR, request_id=random.getrandbits(random.choice((7, 15, 23, 31)))
                    )
                    agent.answer(data, f"127.0.{number >> 8 & 255}.{number & 255}")
                case _:  # the right user, a second later each time
                    agent.answer(self._right.sealed(self._body), LOCAL)

    @staticmethod
    def _plain(community: bytes, *names: Oid, request_id: int = 4711) -> bytes:
        body = pdu(v2c.GetRequestPDU, *names, request_id=request_id)
        return wire.tlv(0x30, wire.integer(0x02, 1) + wire.tlv(0x04, community) + body)


@pytest.mark.parametrize("many", [16_000, pytest.param(1_000_000, marks=[pytest.mark.long, pytest.mark.timeout(3600)])])
def test_memory_is_flat(make_agent: Callable[..., SnmpAgent], clock: StubClock, many: int) -> None:
    agent = make_agent(users=(a_user(),), v1=True, requests_per_s=1e9)
    agent.prepare()
    crowd = Crowd(agent, clock)
    crowd.send(8 * SOURCES_KEPT)  # as many sources as are kept
    gc.collect()
    before = peak_kib()
    crowd.send(many)
    gc.collect()
    assert peak_kib() - before < PLATEAU_KIB
    counters = agent.counters
    assert counters.in_packets == counters.responses + counters.dropped
    assert min(counters.unknown_engine_ids, counters.unknown_user_names, counters.bad_community_names) > many // 9
    assert counters.responses > many // 4
    assert counters.internal_errors == 0
    responder = agent._responder
    assert len(responder._access.known) == SOURCES_KEPT
    assert len(responder._answers.kept) <= MOST_ANSWERS
    assert responder._answers._octets <= MOST_OCTETS
    assert len(responder._singles.known) <= MOST_BEGINNINGS
    assert responder.security is not None
    assert len(responder.security._askers._known) <= MOST_ASKERS
