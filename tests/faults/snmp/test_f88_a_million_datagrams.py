"""F88: a million datagrams; engine ids, users, communities, sources and requests of their own: memory stays flat."""

from __future__ import annotations

import gc
import sys
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import cast

import pytest
from pysnmp.proto.api import v2c

from gateway.faces.snmp import answers, wire
from gateway.faces.snmp.access import SOURCES_KEPT
from gateway.faces.snmp.agent import SnmpAgent
from gateway.faces.snmp.askers import MOST_ASKERS
from gateway.faces.snmp.settings import Oid
from gateway.faces.snmp.singles import MOST_BEGINNINGS
from gateway.faces.snmp.usm import LocalUser
from tests.faces.snmp.poller import Poller, a_user, credentials, pdu
from tests.faces.snmp.stub_site import NOW, StubClock
from tests.faces.snmp.test_responder import LIVE, LOCAL, SYS_DESCR
from tests.faults.snmp.test_f55_malformed_ber import hostile_datagrams

PLATEAU_KIB = 8 * 1024
MOST_ANSWERS = 200
"""Kept here, so that they are soon as many as may be."""


def forget_the_peak() -> None:
    """What other tests took of this process once is not what this one takes."""
    Path("/proc/self/clear_refs").write_text("5")


def peak_kib() -> int:
    status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return int(status["VmHWM"].split()[0])


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
        self._columns = [
            column.base
            for column in agent.tree.columns
            if column.base[: len(LIVE)] == LIVE and agent.tree.get((*column.base, 11), NOW) is not None
        ]

    def ask_for_cells(self) -> None:
        """As nobody did before, most likely; the answer is one that is kept."""
        random = self._random
        names = [(*random.choice(self._columns), random.choice((11, 12, 21))) for _ in range(8)]
        self._agent.answer(self._plain(b"public", *names), LOCAL)

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
                case 5:  # a request whose answer is kept, and one of cells that are not there
                    self.ask_for_cells()
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


class Long:
    """An answer of many octets."""

    charged = 0

    def octets(self) -> int:
        return 10_000


def test_answers_are_kept_up_to_so_many_octets_however_few_they_are() -> None:
    kept = answers.Answers()
    for number in range(1000):
        kept.keep(number.to_bytes(2), cast("answers.Answer", Long()))
        kept.keep(number.to_bytes(2), cast("answers.Answer", Long()))  # in the place of the first
    most = answers.MOST_OCTETS // 10_000
    assert list(kept.kept) == [number.to_bytes(2) for number in range(1000 - most, 1000)], "the oldest go first"
    for key in tuple(kept.kept):
        kept.drop(key)
    assert kept._octets == 0


@pytest.mark.parametrize("many", [16_000, pytest.param(1_000_000, marks=[pytest.mark.long, pytest.mark.timeout(3600)])])
def test_memory_is_flat(
    make_agent: Callable[..., SnmpAgent], clock: StubClock, many: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(answers, "MOST_ANSWERS", MOST_ANSWERS)
    agent = make_agent(users=(a_user(),), v1=True, requests_per_s=1e9)
    agent.prepare()
    crowd = Crowd(agent, clock)
    crowd.send(8 * SOURCES_KEPT)  # all that is bounded is full now: as many sources as are kept, and more answers
    gc.collect()
    forget_the_peak()
    before, blocks = peak_kib(), sys.getallocatedblocks()
    crowd.send(many)
    gc.collect()
    assert peak_kib() - before < PLATEAU_KIB
    assert sys.getallocatedblocks() - blocks < many // 10, "less than one for each of a kind"
    counters = agent.counters
    assert counters.in_packets == counters.responses + counters.dropped
    assert min(counters.unknown_engine_ids, counters.unknown_user_names, counters.bad_community_names) > many // 9
    assert counters.responses > many // 4
    assert counters.internal_errors == 0
    responder = agent._responder
    assert len(responder._access.known) == SOURCES_KEPT
    assert len(responder._answers.kept) == MOST_ANSWERS
    assert len(responder._singles.known) <= MOST_BEGINNINGS
    assert responder.security is not None
    assert len(responder.security._askers._known) <= MOST_ASKERS
