"""Sockets: what is bound, what is said when it cannot be, and a datagram through a real loop."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Callable
from dataclasses import replace
from ipaddress import ip_network
from itertools import pairwise
from typing import cast

import pytest
from pysnmp.proto.api import v2c

from gateway.core.site import Site
from gateway.errors import ListenError
from gateway.faces.snmp.agent import SHARE_S, TURN_S, SnmpAgent
from gateway.faces.snmp.layout import shipped_layout
from gateway.faces.snmp.objects import RowKind
from gateway.faces.snmp.quick import RUN
from gateway.faces.snmp.settings import Community, Emc1Device, SnmpSettings
from tests.cable import Cable
from tests.faces.snmp.stub_site import StubClock, listening
from tests.faces.snmp.test_responder import LIVE, LOCAL, SYS_DESCR, SYS_UP_TIME, Reply, request

POINTS = next(
    table.base
    for table in shipped_layout(SnmpSettings(listen=()).enterprise_root).tables
    if table.rows is RowKind.DEVICE and any(column.point for column in table.columns)
)
"""Where values of controllers begin."""


async def exchange(address: tuple[str, int], data: bytes) -> bytes:
    """One datagram there and one back."""
    loop = asyncio.get_running_loop()
    family = socket.AF_INET6 if ":" in address[0] else socket.AF_INET
    with socket.socket(family, socket.SOCK_DGRAM) as asker:
        asker.setblocking(False)
        asker.connect(address)
        await loop.sock_sendall(asker, data)
        return await asyncio.wait_for(loop.sock_recv(asker, 2000), 5)


@pytest.mark.parametrize("host", ["127.0.0.1", "::1", "localhost"])
async def test_a_listener_answers_and_can_be_started_again(make_agent: Callable[..., SnmpAgent], host: str) -> None:
    agent = make_agent(listen=((host, 0),))
    for _ in range(2):
        async with listening(agent) as bound:
            reply = Reply(await exchange(bound, request(v2c.GetRequestPDU, SYS_DESCR)))
            assert reply.names == [SYS_DESCR]
        assert agent.listeners[0].bound is None


async def test_start_and_stop_may_be_repeated(make_agent: Callable[..., SnmpAgent]) -> None:
    listener = make_agent().listeners[0]
    await listener.stop()
    await listener.start()
    first = listener.bound
    await listener.start()
    assert listener.bound == first
    await listener.stop()
    await listener.stop()


def test_labels_name_the_address(make_agent: Callable[..., SnmpAgent]) -> None:
    agent = make_agent(listen=(("127.0.0.1", 1161), ("::1", 1161)))
    assert [listener.label for listener in agent.listeners] == ["snmp 127.0.0.1:1161", "snmp [::1]:1161"]


async def test_a_taken_port_is_named_and_can_be_tried_again(make_agent: Callable[..., SnmpAgent]) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as holder:
        holder.bind(("127.0.0.1", 0))
        port = holder.getsockname()[1]
        agent = make_agent(listen=(("127.0.0.1", port),))
        with pytest.raises(ListenError, match=rf"snmp 127\.0\.0\.1:{port} \(UDP\): another program listens there$"):
            await agent.listeners[0].start()
        assert agent.listeners[0].bound is None
    async with listening(agent) as bound:
        assert bound == ("127.0.0.1", port)


async def test_an_address_that_is_not_ours_is_named(make_agent: Callable[..., SnmpAgent]) -> None:
    agent = make_agent(listen=(("192.0.2.1", 1161),))
    with pytest.raises(ListenError, match=r"snmp 192\.0\.2\.1:1161"):
        await agent.listeners[0].start()


async def test_both_families_share_a_port(make_agent: Callable[..., SnmpAgent]) -> None:
    agent = make_agent(listen=(("0.0.0.0", 0),))
    async with listening(agent) as (_, port):
        second = make_agent(listen=(("::", port),))
        async with listening(second):
            assert Reply(await exchange(("::1", port), request(v2c.GetRequestPDU, SYS_DESCR))).status == 0
            assert Reply(await exchange(("127.0.0.1", port), request(v2c.GetRequestPDU, SYS_DESCR))).status == 0
        assert second.counters.responses == agent.counters.responses == 1


@pytest.mark.parametrize("number", [0, 1])
async def test_who_asked_one_address_of_many_is_answered_from_it(
    make_agent: Callable[..., SnmpAgent], number: int
) -> None:
    """What the kernel would answer from is another one, and to most askers, and every firewall, that is a stranger."""
    everywhere = ("0.0.0.0", 0)
    agent = make_agent(listen=(everywhere,), emc1=(Emc1Device(11, (everywhere,)),))
    async with listening(agent, number) as (_, port):
        for host in ("127.0.0.1", "127.0.0.2", "127.1.2.3"):
            for _ in range(2):  # the second time it is answered from what is kept
                assert Reply(await exchange((host, port), request(v2c.GetRequestPDU, SYS_DESCR))).status == 0
    assert agent.counters.responses == 6


@pytest.mark.parametrize("link_local", [False, True])
async def test_over_ipv6_too(make_agent: Callable[..., SnmpAgent], cable: Cable, *, link_local: bool) -> None:
    asked = "fe80::5047:1" if link_local else "fd50:4757::1"
    cable.run("addr", "add", f"{asked}/64", "dev", cable.near, "nodad")
    agent = make_agent(listen=(("::", 0),), communities=(Community("public", (ip_network("::/0"),)),))
    async with listening(agent) as (_, port):
        to = (asked, port, 0, socket.if_nametoindex(cable.near) if link_local else 0)
        with socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as asker:
            asker.setblocking(False)
            if not link_local:
                asker.bind(("::1", 0))  # to which the kernel would answer from the same
            asker.connect(to)
            await asyncio.get_running_loop().sock_sendall(asker, request(v2c.GetRequestPDU, SYS_DESCR))
            assert Reply(await asyncio.wait_for(asyncio.get_running_loop().sock_recv(asker, 2000), 5)).status == 0


async def test_hostile_datagrams_do_not_stop_the_server(make_agent: Callable[..., SnmpAgent]) -> None:
    agent = make_agent()
    wrong = [b"", b"\x30", b"\x30\x84\xff\xff\xff\xff", b"\x00" * 1472, b"\x30" * 9000, request(v2c.ReportPDU)]
    async with listening(agent) as bound:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asker:
            for data in wrong:
                asker.sendto(data, bound)
        reply = await exchange(bound, request(v2c.GetRequestPDU, SYS_DESCR))
    assert Reply(reply).status == 0
    assert agent.counters.in_packets == len(wrong) + 1
    assert agent.counters.dropped == len(wrong)


async def test_an_asker_that_is_gone_does_not_stop_the_server(make_agent: Callable[..., SnmpAgent]) -> None:
    agent = make_agent()
    async with listening(agent) as bound:
        for _ in range(3):
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as gone:
                gone.sendto(request(v2c.GetRequestPDU, SYS_DESCR), bound)
        assert Reply(await exchange(bound, request(v2c.GetRequestPDU, SYS_DESCR))).status == 0


class Flood:
    """A socket in which there is always one more datagram; each takes a while to answer."""

    def __init__(
        self, clock: StubClock, data: bytes, takes_s: float = 0.0001, meanwhile: Callable[[], None] = lambda: None
    ) -> None:
        self._clock = clock
        self._data = data
        self._meanwhile = meanwhile
        self._takes_s = takes_s
        self.taken = 0
        self.sent = 0

    def recvfrom(self, _size: int) -> tuple[bytes, tuple[str, int]]:
        self._clock.now += self._takes_s
        self._meanwhile()
        self.taken += 1
        return self._data, (LOCAL, 4711)

    def sendto(self, _data: bytes, _address: object) -> None:
        self.sent += 1


@pytest.mark.parametrize("known", [True, False])
def test_a_flood_gets_a_turn_and_no_more(
    make_agent: Callable[..., SnmpAgent], clock: StubClock, *, known: bool
) -> None:
    """Others of the event loop have their turn after a millisecond, however many datagrams wait."""
    agent = make_agent(requests_per_s=1e9)
    name = (*LIVE, 9, 11) if known else (1, 3)
    flood = Flood(clock, request(v2c.GetRequestPDU, name))
    for _ in range(2):
        flood.taken = flood.sent = agent.counters.in_packets = agent.counters.responses = 0
        agent.answer_waiting(cast("socket.socket", flood))
    at_once = round(TURN_S / 0.0001)
    assert at_once <= flood.taken == flood.sent <= at_once + len(RUN)
    assert agent.counters.in_packets == agent.counters.responses == flood.taken


@pytest.mark.parametrize(
    "gives", ["one number, known", "one cell, known", "fifty cells, changed", "clock, never known"]
)
def test_in_a_turn_others_are_let_through_again_and_again(
    make_agent: Callable[..., SnmpAgent], site: Site, clock: StubClock, gives: str
) -> None:
    """A Modbus client waits for SHARE_S of datagrams at most, and for the request that is under way then."""
    takes_s, at_most, data = {
        "one number, known": (SHARE_S / 6, len(RUN), request(v2c.GetRequestPDU, (*LIVE, 9, 11))),
        "one cell, known": (SHARE_S / 6, len(RUN), request(v2c.GetRequestPDU, SYS_DESCR)),
        "fifty cells, changed": (SHARE_S / 0.9, 1, request(v2c.GetBulkRequestPDU, POINTS, bulk=(0, 50))),
        "clock, never known": (SHARE_S / 0.9, 1, request(v2c.GetRequestPDU, SYS_DESCR, SYS_UP_TIME)),
    }[gives]

    def poll() -> None:
        if gives == "fifty cells, changed":
            site.devices[0].snapshot = replace(site.devices[0].snapshot, version=site.devices[0].snapshot.version + 1)

    let_through: list[int] = []
    flood = Flood(clock, data, takes_s, poll)
    agent = make_agent(requests_per_s=1e9, give_way=lambda: let_through.append(flood.sent))
    for _ in range(2):  # what can be known is known the second time
        flood.sent = 0
        clock.now += 1.0
        let_through.clear()
        agent.answer_waiting(cast("socket.socket", flood))
    waits = [after - before for before, after in pairwise([0, *let_through])]
    assert max(waits) <= at_most
    assert (let_through[0], let_through[-1]) == (0, flood.sent)
    assert len(let_through) >= TURN_S / SHARE_S / 4


def test_the_time_of_those_who_are_let_through_is_of_the_turn(
    make_agent: Callable[..., SnmpAgent], clock: StubClock
) -> None:
    """However long Modbus clients take, the rest of the event loop has its turn after a millisecond."""

    def take() -> None:
        clock.now += TURN_S

    flood = Flood(clock, request(v2c.GetRequestPDU, SYS_DESCR), SHARE_S)
    make_agent(requests_per_s=1e9, give_way=take).answer_waiting(cast("socket.socket", flood))
    assert flood.sent <= len(RUN)
