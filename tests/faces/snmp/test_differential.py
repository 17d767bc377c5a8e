"""An agent that remembers, one that forgets everything between two datagrams, and an oracle: the same answers.

Both agents have the same engine, start and clock and are sent the same datagrams, so their replies and counters have to
be the same. SNMPv1 and v2c: octet for octet. SNMPv3: level, boots, time and PDU (the salt makes the ciphertext differ).
"""

from __future__ import annotations

import socket
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from ipaddress import ip_network
from typing import cast

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from pyasn1.codec.ber import decoder, encoder
from pysnmp.proto import rfc1905
from pysnmp.proto.api import v2c

from gateway.core.site import Device, Site
from gateway.core.snapshot import Snapshot
from gateway.faces.snmp import reader, v3, wire
from gateway.faces.snmp.agent import SnmpAgent
from gateway.faces.snmp.emc1 import context_of
from gateway.faces.snmp.engine import Engine
from gateway.faces.snmp.settings import EVERYTHING, REPLY_LIMIT, Community, Emc1Device, Oid, View
from gateway.faces.snmp.usm import LocalUser
from tests.faces.snmp.oracle import MISSING, Oracle, Pairs
from tests.faces.snmp.poller import AUTH_PHRASE, LOOPBACK, Poller, Read, a_user, credentials, pdu
from tests.faces.snmp.stub_site import NOW, StubClock, stale
from tests.faces.snmp.test_paths import KINDS
from tests.faces.snmp.test_responder import LIVE, LOCAL, SYS_DESCR, SYS_UP_TIME

V1, V2C, V3 = reader.VERSION_1, reader.VERSION_2C, reader.VERSION_3
DEVICES: Oid = (*LIVE[:-2], 3, 1)
SNMP_GROUP = (1, 3, 6, 1, 2, 1, 11)
PART = View((LIVE, SYS_DESCR[:-2]), ((*LIVE, 10),))
ASKED = st.sampled_from(
    [
        SYS_DESCR,
        SYS_UP_TIME,
        (0, 0),
        (1, 3),
        (2, 5),
        (1, 3, 6, 1, 6, 3),
        SNMP_GROUP,
        (*SNMP_GROUP, 1, 0),
        *((*LIVE, column) for column in (8, 9, 12, 24, 44, 900)),
        *((*LIVE, column, unit) for column in (9, 10, 24) for unit in (11, 12, 21, 99)),
        *((*DEVICES, column, unit) for column in (2, 10, 12) for unit in (11, 12)),
    ]
)
SINGLES = st.sampled_from([0, 0, 0, 1, 1, 2, 2**31 - 1])
REPETITIONS = st.sampled_from([0, 1, 2, 3, 7, 30, 2**31 - 1])
NEAR, FAR = LOCAL, "127.0.0.2"
EMC1_UNIT = 11


@dataclass(frozen=True)
class Step:
    """What is asked, by whom, what happens to the datagram on its way, and what to the site before it comes."""

    version: int
    kind: type
    names: list[Oid]
    bulk: tuple[int, int]
    request_id: int
    who: str  # credential: "all", "part", or what is wrong with it
    broken: tuple[int, int] | None  # octet that is changed on its way the last time, what it becomes
    change: str
    host: str = NEAR
    context: bytes = b""  # of the listener


STEPS = st.builds(
    Step,
    version=st.sampled_from([V1, V2C, V2C, V3, V3]),
    kind=st.sampled_from([*KINDS, v2c.GetBulkRequestPDU, v2c.SetRequestPDU]),
    names=st.lists(ASKED, max_size=4),
    bulk=st.tuples(SINGLES, REPETITIONS),
    request_id=st.sampled_from([0, 1, 4711, 2**31 - 1, -5]),
    who=st.sampled_from(["all"] * 12 + ["part"] * 4 + ["name", "key", "phrase", "level", "clear", "context", "engine"]),
    broken=st.one_of(st.none(), st.tuples(st.integers(0, 200), st.integers(0, 255))),
    change=st.sampled_from(["nothing"] * 4 + ["values", "stale", "online", "fewer", "gone", "second", "minutes"]),
    host=st.sampled_from([NEAR] * 4 + [FAR]),
    context=st.sampled_from([b""] * 6 + [context_of(EMC1_UNIT)]),
)


class Wire:
    """A socket with one datagram in it, for the real way in and out."""

    def __init__(self, agent: SnmpAgent) -> None:
        self._agent = agent
        self._waiting: list[bytes] = []
        self._sent: list[bytes] = []
        self._host = NEAR

    def exchange(self, data: bytes, host: str = NEAR, context: bytes = b"") -> bytes | None:
        self._waiting, self._sent, self._host = [data], [], host
        self._agent.answer_waiting(cast("socket.socket", self), context)
        assert len(self._sent) <= 1
        return self._sent[0] if self._sent else None

    def recvfrom(self, size: int) -> tuple[bytes, tuple[str, int]]:
        if not self._waiting:
            raise BlockingIOError
        return self._waiting.pop()[:size], (self._host, 4711)

    def sendto(self, data: bytes, _address: object) -> None:
        self._sent.append(data)


def forget(agent: SnmpAgent) -> None:
    """Take away everything that the quick ways live on."""
    responder = agent._responder
    responder._answers.kept.clear()
    responder._singles.known.clear()
    assert responder.security is not None
    responder.security._askers._known.clear()


class Pair:
    """The two agents, and pollers that know their engine."""

    def __init__(self, make_agent: Callable[..., SnmpAgent], site: Site, clock: StubClock) -> None:
        self.site = site
        self.clock = clock
        self._before = {unit: device.snapshot for unit, device in site.by_unit.items()}
        shown = View(EVERYTHING.include, (SNMP_GROUP,))  # the agents' own counters go with the oracle only by luck
        self.views = {"all": shown, "part": PART}
        sources = {"all": LOOPBACK, "part": (ip_network(f"{NEAR}/32"),)}
        self.agents = [
            make_agent(
                communities=tuple(Community(name, sources[name], view) for name, view in self.views.items()),
                users=tuple(
                    replace(a_user(name), sources=sources[name], view=view) for name, view in self.views.items()
                ),
                emc1=(Emc1Device(EMC1_UNIT),),
                v1=True,
                requests_per_s=1e9,
            )
            for _ in range(2)
        ]
        engine = Engine(bytes.fromhex("80007ed9050102030405060708"), 3, clock.now)
        for agent in self.agents:
            agent._engine = engine
            agent.prepare()
        self.wires = [Wire(agent) for agent in self.agents]
        self._authority = v3.Authority(engine.engine_id, engine.boots, 0)
        self._users = {name: LocalUser(credentials(name), engine.engine_id) for name in self.views}
        self._users["name"] = LocalUser(credentials("nobody"), engine.engine_id)
        self._users["key"] = LocalUser(credentials("all", phrases=("another phrase", "private phrase")), b"12345")
        self._users["phrase"] = LocalUser(credentials("all", phrases=(AUTH_PHRASE, "another one")), engine.engine_id)
        self._made = 0

    def start_anew(self) -> None:
        """As at the start, but for the counters."""
        self.clock.now = NOW
        for unit, device in self.site.by_unit.items():
            device.snapshot = self._before[unit]
        for agent in self.agents:
            forget(agent)

    def datagram(self, step: Step) -> tuple[bytes, Poller]:
        """The datagram of a step, and who can read the reply."""
        poller = Poller(lambda _data: None, user=self._users.get(step.who, self._users["all"]))
        poller.authority = self._authority._replace(time=int(self.clock.now - NOW))
        body = pdu(step.kind, *step.names, bulk=step.bulk, request_id=step.request_id)
        if step.version != V3:
            community = step.who.encode() if step.who in self.views or step.who == "name" else b"all"
            community += b"@elsewhere" if step.who == "context" else b""
            data = wire.tlv(0x30, wire.integer(2, step.version) + wire.tlv(4, community) + body)
        else:
            self._made += 1
            poller.message_id = self._made
            poller.context = b"elsewhere" if step.who == "context" else b""
            flags = {"level": v3.AUTH | v3.REPORTABLE, "clear": v3.REPORTABLE}.get(step.who, 7)
            data = poller.sealed(body, flags, b"12345" if step.who == "engine" else None)
        poller.user = self._users["phrase" if step.who == "phrase" else "part" if step.who == "part" else "all"]
        return data, poller


@pytest.fixture
def pair(make_agent: Callable[..., SnmpAgent], site: Site, clock: StubClock) -> Pair:
    return Pair(make_agent, site, clock)


def change_device(device: Device, full: Snapshot, change: str, version: int) -> None:
    match change:
        case "values":
            values = {name: value + version % 7 for name, value in full.values.items()}
            device.snapshot = replace(full, version=version, values=values)
        case "stale":
            device.snapshot = stale(replace(full, version=version))
        case "online":
            device.snapshot = replace(full, version=version)
        case "fewer":
            device.snapshot = replace(full, version=version, values=dict(list(full.values.items())[:20]))
        case "gone":
            device.snapshot = Snapshot()
        case _:
            pass


def meaning(reply: bytes, step: Step, poller: Poller) -> Read | tuple[int, int, Pairs]:
    """An SNMPv3 reply as it was read, else status, index and varbinds."""
    if step.version == V3:
        return poller.read(reply)
    return read_pdu(bare_pdu(reply))


def bare_pdu(reply: bytes) -> bytes:
    """The PDU in a message with a community."""
    return reply[reader.community(reply, reader.version(reply)[2])[1] :]


def read_pdu(data: bytes) -> tuple[int, int, Pairs]:
    found, rest = decoder.decode(data, asn1Spec=rfc1905.PDUs())
    assert rest == b""
    read = found.getComponent()
    return int(read[1]), int(read[2]), [(tuple(each[0]), encoder.encode(each[1].getComponent())) for each in read[3]]


def assert_as_the_oracle_says(pair: Pair, step: Step, data: bytes) -> None:
    status, index, found = read_pdu(data)
    if step.kind is v2c.SetRequestPDU:
        assert (status, index) == (2 if step.version == V1 else 17, min(1, len(step.names)))
        return
    tree = pair.agents[0]._responder._contexts[step.context]
    expected = Oracle(tree, pair.views[step.who], pair.clock.now).ask(step.kind, step.names, step.bulk)
    found = [(name, MISSING if value[:1] in {b"\x80", b"\x81"} else value) for name, value in found]
    missing = [at for at, (_, value) in enumerate(expected, 1) if value[:1] in {b"\x81", b"\x82"}]
    if step.version == V1 and missing:
        assert (status, index) == (2, missing[0])
        return
    assert (status, index) == (0, 0)
    assert found == expected[: len(found)]
    if len(found) < len(expected):
        assert step.kind is v2c.GetBulkRequestPDU
        assert len(data) > REPLY_LIMIT - 300  # it was full


def assert_the_same(pair: Pair, step: Step, data: bytes, poller: Poller | None) -> None:
    """Both agents answer a datagram in the same way; with a poller that can read it, as the oracle says too."""
    forget(pair.agents[1])
    quick, slow = (wire.exchange(data, step.host, step.context) for wire in pair.wires)
    counters = [asdict(agent.counters) for agent in pair.agents]
    assert counters[0] == counters[1]
    assert counters[0]["internal_errors"] == 0
    assert (quick is None) == (slow is None)
    if quick is None or slow is None:
        return
    if step.version != V3:
        assert quick == slow
    if poller is None:
        return
    read = meaning(quick, step, poller)
    assert read == meaning(slow, step, poller)
    response = not isinstance(read, Read) or read.kind == "ResponsePDU"
    assert response == (may_read(pair, step) or step.version != V3)
    if response and may_read(pair, step):
        assert_as_the_oracle_says(pair, step, read.pdu if isinstance(read, Read) else bare_pdu(quick))


def may_read(pair: Pair, step: Step) -> bool:
    """Whether nothing is wrong with the credential."""
    return step.who == "all" or (step.who in pair.views and step.host == NEAR)


CELL: Oid = (*LIVE, 9, 11)
OTHER_CELL: Oid = (*LIVE, 24, 21)
USUAL = [
    Step(version, kind, names, (0, 3), 4711, who, None, change)
    for version in (V2C, V3)
    for change in ("nothing", "values", "gone", "online")
    for who in ("part", "all")
    for kind, names in (
        (v2c.GetRequestPDU, [CELL]),
        (v2c.GetNextRequestPDU, [CELL]),
        (v2c.GetNextRequestPDU, [(*LIVE, 43, 21), CELL, (*LIVE, 9, 12)]),
        (v2c.GetRequestPDU, [CELL, OTHER_CELL]),
        (v2c.GetBulkRequestPDU, [CELL]),
        (v2c.GetBulkRequestPDU, [CELL, OTHER_CELL]),
    )
] + [
    # One octet of what stands around the name of a known request is another one.
    Step(V2C, v2c.GetRequestPDU, [CELL], (0, 0), 4711, "all", (at, octet), "nothing")
    for at in (-1, -2, *range(-30, -18))
    for octet in (0x01, 0x31)
]


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=40, deadline=None)
@given(steps=st.lists(STEPS, min_size=5, max_size=15))
@example(steps=USUAL)
def test_any_sequence_is_answered_as_by_an_agent_that_forgets(pair: Pair, steps: list[Step]) -> None:
    pair.start_anew()
    clock, full = pair.clock, pair.site.by_unit[21].snapshot
    for version, step in enumerate(steps, 10):
        # Most happens to one device, and every third time to all of them: then whole columns are empty.
        for unit in (11, 12, 21) if version % 3 == 0 else (11,):
            change_device(pair.site.by_unit[unit], full, step.change, version)
        clock.now += {"second": 1, "minutes": 100}.get(step.change, 0)
        # Twice as it is: the second time by whatever was learned the first time. Then with an octet changed, from the
        # other host, and at the other listener.
        for _ in range(2):
            assert_the_same(pair, step, *pair.datagram(step))
        if step.broken is not None:
            data, _ = pair.datagram(step)
            at = step.broken[0] % len(data)
            assert_the_same(pair, step, data[:at] + bytes((step.broken[1],)) + data[at + 1 :], None)
        elsewhere = replace(step, host=FAR if step.host == NEAR else NEAR)
        other = replace(step, context=b"" if step.context else context_of(EMC1_UNIT))
        for each in (elsewhere, other):
            assert_the_same(pair, each, *pair.datagram(each))


@pytest.mark.parametrize(
    ("kind", "names"),
    [
        (v2c.GetRequestPDU, [(*LIVE, 9, 11)]),
        (v2c.GetNextRequestPDU, [(*LIVE, 9, 11)]),
        (v2c.GetRequestPDU, [(*LIVE, 9, 11), SYS_DESCR]),
        (v2c.GetBulkRequestPDU, [(*LIVE, 9)]),
    ],
)
def test_the_second_time_the_quick_ways_answer_and_what_changed_is_seen(
    pair: Pair, kind: type, names: list[Oid]
) -> None:
    agent = pair.agents[0]
    steps = [Step(version, kind, names, (0, 10), 4711, "all", None, "") for version in (V2C, V3)]

    def ask() -> list[tuple[int, int, Pairs]]:
        found = []
        for step in steps:
            data, poller = pair.datagram(step)
            reply = pair.wires[0].exchange(data)
            assert reply is not None
            read = meaning(reply, step, poller)
            found.append(read_pdu(read.pdu) if isinstance(read, Read) else read)
        return found

    first = ask()
    assert first[0] == first[1]
    with pytest.MonkeyPatch.context() as patch:
        # Whoever takes the long way now fails.
        patch.setattr(agent._responder.security, "open", None)
        patch.setattr(reader, "plain_request", None)
        patch.setattr(reader, "odd_request", None)
        assert ask() == first
        for unit in (11, 21):
            change_device(pair.site.by_unit[unit], pair.site.by_unit[unit].snapshot, "values", 2)
        assert ask() != first
    assert agent.counters.internal_errors == 0
