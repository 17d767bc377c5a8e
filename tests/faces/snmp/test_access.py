"""Nothing without an entry that allows it; nothing but reading with one."""

from __future__ import annotations

from collections.abc import Callable
from ipaddress import ip_address, ip_network

import pytest
from pysnmp.proto.api import v2c

from gateway.faces.snmp.access import SOURCES_KEPT, Access, source_address
from gateway.faces.snmp.agent import SnmpAgent
from gateway.faces.snmp.responder import Refusal, Refused
from gateway.faces.snmp.settings import Community, SnmpSettings, View
from tests.faces.snmp.stub_site import StubClock
from tests.faces.snmp.test_responder import LOCAL, SYS_DESCR, Reply, request

LOOPBACK = ip_network("127.0.0.0/8")
MANAGERS = ip_network("192.0.2.0/24")


def access(*communities: Community) -> Access:
    return Access(communities, (), lambda view: {}, requests_per_s=100.0)


def usable(access: Access, host: str) -> set[bytes]:
    source = access.source(host)
    return set() if source is None else set(source.communities)


def test_there_is_no_credential_by_default() -> None:
    assert (SnmpSettings().communities, SnmpSettings().users) == ((), ())


def test_an_empty_list_allows_nobody() -> None:
    assert access().source(LOCAL) is None


def test_a_community_without_networks_allows_nobody() -> None:
    assert access(Community("public", ())).source(LOCAL) is None


def test_a_community_counts_only_from_its_own_networks() -> None:
    made = access(Community("public", (LOOPBACK,)), Community("noc", (MANAGERS, ip_network("2001:db8::/32"))))
    assert usable(made, LOCAL) == {b"public"}
    assert usable(made, "192.0.2.9") == {b"noc"}
    assert usable(made, "::ffff:192.0.2.9") == {b"noc"}
    assert usable(made, "2001:db8::1") == {b"noc"}
    assert made.source("198.51.100.1") is None


def test_a_name_given_twice_has_the_networks_of_both() -> None:
    made = access(Community("public", (LOOPBACK,)), Community("public", (MANAGERS,)))
    assert usable(made, LOCAL) == usable(made, "192.0.2.9") == {b"public"}


def test_what_is_kept_of_addresses_is_bounded() -> None:
    made = access(Community("public", (ip_network("0.0.0.0/0"),)))
    for number in range(3 * SOURCES_KEPT):
        made.source(f"10.1.{number // 256}.{number % 256}")
    assert len(made.known) == SOURCES_KEPT


def test_an_allowance_is_used_up_and_comes_back_with_time() -> None:
    source = access(Community("public", (LOOPBACK,))).source(LOCAL)
    assert source is not None
    assert sum(source.take(5.0) for _ in range(5000)) == 1000  # ten seconds' worth
    assert sum(source.take(5.5) for _ in range(5000)) == 50
    assert sum(source.take(1000.0) for _ in range(5000)) == 1000


@pytest.mark.parametrize(
    ("view", "oid", "shown"),
    [
        (View(), SYS_DESCR, False),
        (View(((1, 3, 6, 1, 2, 1),)), SYS_DESCR, True),
        (View(((1, 3, 6, 1, 2, 1),)), (1, 3, 6, 1, 2), False),
        (View(((1, 3, 6, 1, 2, 1),), ((1, 3, 6, 1, 2, 1, 1),)), SYS_DESCR, False),
        (View(((1, 3, 6, 1, 2, 1, 1, 1),), ((1, 3, 6, 1, 2, 1, 1),)), SYS_DESCR, True),
        (View((SYS_DESCR,), (SYS_DESCR,)), SYS_DESCR, False),
    ],
)
def test_the_longest_subtree_of_a_view_decides(view: View, oid: tuple[int, ...], shown: bool) -> None:
    assert view.shows(oid) is shown


def test_a_view_is_all_that_a_community_can_reach(make_agent: Callable[..., SnmpAgent], clock: StubClock) -> None:
    system = (1, 3, 6, 1, 2, 1, 1)
    narrow = View((system,), ((*system, 9), (*system, 1)))
    agent = make_agent(communities=(Community("narrow", (LOOPBACK,), narrow), Community("blind", (LOOPBACK,), View())))

    def ask(kind: type, *names: tuple[int, ...], community: bytes = b"narrow") -> Reply:
        return Reply(agent._responder.answer(request(kind, *names, community=community), LOCAL, clock.now))

    seen: list[tuple[int, ...]] = []
    at: tuple[int, ...] = (1, 3)
    while (reply := ask(v2c.GetNextRequestPDU, at)).kinds() != ["EndOfMibView"]:
        seen.append(at := reply.names[0])
    assert seen == [(*system, number, 0) for number in range(2, 9)]
    assert ask(v2c.GetRequestPDU, SYS_DESCR, (1, 3, 6, 1, 2, 1, 11, 1, 0)).kinds() == ["NoSuchObject"] * 2
    assert ask(v2c.GetRequestPDU, (*system, 4, 0)).kinds() != ["NoSuchObject"]
    assert ask(v2c.GetNextRequestPDU, (1, 3), community=b"blind").kinds() == ["EndOfMibView"]
    assert ask(v2c.GetRequestPDU, (*system, 4, 0), community=b"blind").kinds() == ["NoSuchObject"]


def test_addresses_in_ipv6_clothes_are_taken_for_what_they_are() -> None:
    assert source_address("::ffff:192.0.2.9") == ip_address("192.0.2.9")
    assert source_address("fe80::1%eth0") == ip_address("fe80::1")


def test_a_community_is_not_shown() -> None:
    assert "s3cret" not in repr(SnmpSettings(communities=(Community("s3cret", (LOOPBACK,)),)))


@pytest.mark.parametrize(
    ("community", "source", "refusal"),
    [
        (b"private", "127.0.0.1", Refusal.COMMUNITY),
        (b"", "127.0.0.1", Refusal.COMMUNITY),
        (b"elsewhere", "127.0.0.1", Refusal.COMMUNITY),  # right name, wrong network
        (b"public", "192.0.2.9", Refusal.COMMUNITY),
        (b"public", "198.51.100.1", Refusal.SOURCE),
    ],
)
@pytest.mark.parametrize("kind", [v2c.GetRequestPDU, v2c.SetRequestPDU])
def test_refusals_are_silent_and_counted(
    agent: SnmpAgent, kind: type, community: bytes, source: str, refusal: Refusal
) -> None:
    with pytest.raises(Refused) as refused:
        agent._responder.answer(request(kind, SYS_DESCR, community=community), source, 0.0)
    assert refused.value.refusal is refusal
    by_community = refusal is Refusal.COMMUNITY
    assert (agent.counters.bad_community_names, agent.counters.refused_sources) == (by_community, not by_community)
    assert agent.counters.responses == 0


def test_an_unlisted_source_is_refused_before_its_datagram_is_looked_at(agent: SnmpAgent, clock: StubClock) -> None:
    with pytest.raises(Refused) as refused:
        agent._responder.answer(b"\xff" * 5000, "198.51.100.1", clock.now)
    assert refused.value.refusal is Refusal.SOURCE
    assert agent.counters.parse_errors == agent.counters.oversized == 0


@pytest.mark.parametrize("community", [b"public", b"noc"])
def test_no_credential_sees_the_engines_own_tree_or_can_set(
    make_agent: Callable[..., SnmpAgent], clock: StubClock, community: bytes
) -> None:
    agent = make_agent(communities=(Community("public", (LOOPBACK,)), Community("noc", (LOOPBACK, MANAGERS))))

    def ask(kind: type, *names: tuple[int, ...]) -> Reply:
        return Reply(agent._responder.answer(request(kind, *names, community=community), LOCAL, clock.now))

    for subtree in ((1, 3, 6, 1, 6, 3), (1, 3, 6, 1, 4, 1, 20408), (1, 3, 6, 1, 6)):
        reply = ask(v2c.GetNextRequestPDU, subtree)
        assert reply.names[0][: len(subtree)] != subtree or reply.kinds() == ["EndOfMibView"]
        assert ask(v2c.GetRequestPDU, (*subtree, 1, 0)).kinds() == ["NoSuchObject"]
    every = [slot.oid for slot in agent.tree]
    assert {oid[:6] for oid in every} == {(1, 3, 6, 1, 2, 1), (1, 3, 6, 1, 4, 1)}
    assert {oid[6] for oid in every if oid[4] == 4} == {32473}
    for oid in (*every[:3], every[-1], (1, 3, 6, 1, 6, 3, 1, 1, 6, 1, 0)):
        assert ask(v2c.SetRequestPDU, oid).status == 17


def test_refusals_are_logged_once_and_then_by_count(
    agent: SnmpAgent, clock: StubClock, caplog: pytest.LogCaptureFixture
) -> None:
    wrong = request(v2c.GetRequestPDU, SYS_DESCR, community=b"hunter2")
    for _ in range(500):
        assert agent.answer(wrong, "127.0.0.1") is None
    assert [record.getMessage() for record in caplog.records if "snmp_dropped" in record.getMessage()] == [
        "event=snmp_dropped reason=community source=127.0.0.1 count=1"
    ]
    clock.now += 61
    agent.answer(wrong, "127.0.0.1")
    assert caplog.records[-1].getMessage() == "event=snmp_dropped reason=community source=127.0.0.1 count=500"
    assert "hunter2" not in caplog.text
