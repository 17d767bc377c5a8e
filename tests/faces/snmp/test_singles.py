"""GET and GETNEXT of one cell: what is answered by look-ups is what an agent that forgets everything answers."""

from __future__ import annotations

import socket
import tracemalloc
from collections.abc import Callable
from dataclasses import asdict, replace
from typing import cast

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from pysnmp.proto.api import v2c

from gateway.core.site import Device, Site
from gateway.core.snapshot import DeviceState
from gateway.devices.model import DeviceMap
from gateway.devices.schema import load_map
from gateway.faces.snmp import reader
from gateway.faces.snmp.agent import SnmpAgent
from gateway.faces.snmp.columns import Column
from gateway.faces.snmp.settings import EVERYTHING, Oid
from gateway.faces.snmp.singles import Single
from tests.faces.snmp.oracle import END_OF_MIB_VIEW, MISSING, Oracle
from tests.faces.snmp.stub_site import StubClock, StubLine, online
from tests.faces.snmp.test_differential import V2C, V3, Pair, Step, forget, meaning, read_pdu
from tests.faces.snmp.test_responder import LIVE, SYS_DESCR, request

UNITS = (11, 12, 21, 126, 127, 128, 129, 247)  # from 128 on an index takes two octets
TRISTAR = 12
GET, NEXT = v2c.GetRequestPDU, v2c.GetNextRequestPDU
COLUMNS = [(*LIVE, column) for column in (9, 10, 12, 24, 43, 44, 45, 62)]
ROWS = st.sampled_from([*((unit,) for unit in (*UNITS, 10, 200)), (), (11, 0)])


@pytest.fixture
def site(device_map: DeviceMap) -> Site:
    """A ProStar at every unit id, but for a TriStar."""
    line = StubLine("a", 1, "/dev/ttyA")
    devices = [
        Device(f"unit-{unit}", unit, 1, load_map("tristar-mppt") if unit == TRISTAR else device_map) for unit in UNITS
    ]
    for device in devices:
        device.line = line
        device.snapshot = online(device.map, device.unit_id)
    return Site.of("many", [line], devices)


@pytest.fixture
def pair(make_agent: Callable[..., SnmpAgent], site: Site, clock: StubClock) -> Pair:
    return Pair(make_agent, site, clock)


def asked(name: Oid, kind: type, version: int = V2C) -> Step:
    return Step(version, kind, [name], (0, 0), 4711, "all", None, "")


def become(device: Device, change: object, version: int) -> None:
    """All values of a device become a number, go ("none"), or hold while its state is another one."""
    snapshot = replace(device.snapshot, version=version)
    match change:
        case DeviceState():
            device.snapshot = replace(snapshot, state=change)
        case int() | float():
            device.snapshot = replace(snapshot, values=dict.fromkeys(online(device.map, 1).values, change))
        case "none":
            device.snapshot = replace(snapshot, values={})
        case _:
            assert change == "nothing"
            device.snapshot = snapshot


CHANGES = st.one_of(
    st.sampled_from(["nothing", "none", *DeviceState]),
    st.sampled_from([0, 1, 0.125, 0.127, 0.128, 127, 128, 32.767, 32.768, -0.129, 65536, 2e6, 3e6, -1, 1e300]),
    st.floats(width=16, allow_nan=False, allow_infinity=False),
)
MOVES = st.tuples(
    st.sampled_from(UNITS),
    CHANGES,
    st.sampled_from(COLUMNS),
    ROWS,
    st.sampled_from([GET, NEXT]),
    st.sampled_from([V2C, V3]),
)
Move = tuple[int, object, Oid, tuple[int, ...], type, int]
LENGTHS: list[Move] = [
    (unit, change, (*LIVE, 9), (row,), kind, version)
    for change in (0.1, 100, 0.2, DeviceState.STALE, 5, DeviceState.ONLINE, "none", 1e300, 7)
    for version in (V2C, V3)
    for kind, unit, row in ((GET, 21, 21), (NEXT, 21, 11), (GET, 128, 128), (NEXT, 128, 127), (NEXT, 247, 247))
]


class NearOracle(Oracle):
    """Of the tables around the columns that are asked for; what lies behind them it does not know."""

    def __init__(self, pair: Pair) -> None:
        near = [cell for cell in pair.agents[0].tree if (*LIVE, 9) <= cell.oid < (*LIVE, 70)]
        super().__init__(near, EVERYTHING, pair.clock.now)


def assert_as_it_is(pair: Pair, step: Step) -> None:
    forget(pair.agents[1])
    data, poller = pair.datagram(step)
    replies = [wire.exchange(data) for wire in pair.wires]
    counters = [asdict(agent.counters) for agent in pair.agents]
    assert counters[0] == counters[1]
    assert counters[0]["internal_errors"] == 0
    quick, slow = (meaning(reply or b"", step, poller) for reply in replies)
    assert quick == slow
    status, _, found = quick if isinstance(quick, tuple) else read_pdu(quick.pdu)
    assert status == 0
    expected = NearOracle(pair).ask(step.kind, step.names, (0, 0))
    if expected[0][1] == MISSING:
        assert found[0][1][:1] in {b"\x80", b"\x81"}
    elif expected[0][1] != END_OF_MIB_VIEW:
        assert found == expected


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=25, deadline=None)
@given(moves=st.lists(MOVES, min_size=3, max_size=10))
@example(moves=LENGTHS)
def test_whatever_changes_it_is_answered_as_by_an_agent_that_forgets(pair: Pair, moves: list[Move]) -> None:
    pair.start_anew()
    for version, (unit, change, column, row, kind, spoken) in enumerate(moves, 2):
        step = asked((*column, *row), kind, spoken)
        assert_as_it_is(pair, step)
        become(pair.site.by_unit[unit], change, version)
        for _ in range(2):
            assert_as_it_is(pair, step)


def number_columns(agent: SnmpAgent) -> list[Column]:
    return [column for column in agent.tree.columns if column.object.encodings is not None]


@pytest.mark.parametrize("version", [V2C, V3])
@pytest.mark.parametrize("kind", [GET, NEXT])
def test_numbers_of_points_are_looked_up_and_nothing_else(
    pair: Pair, kind: type, version: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whoever reads a cell in another way fails here, once it was asked for one row with an index as long."""
    agent = pair.agents[0]
    columns = number_columns(agent)
    assert len(columns) > 100

    def ask() -> list[bytes]:
        values = []
        for column in columns:
            for index in column.rows.indexes[:-1]:
                step = asked((*column.base, *index), kind, version)
                data, poller = pair.datagram(step)
                reply = pair.wires[0].exchange(data)
                assert reply is not None
                found = meaning(reply, step, poller)
                values.append(repr(found).encode() if isinstance(found, tuple) else found.pdu)
        return values

    first = ask()
    for each in ("plain_request", "odd_request"):
        monkeypatch.setattr(reader, each, None)
    long_way = Single.reply
    taken: list[bytes] = []

    def noted(single: Single, data: bytes, now: float) -> bytes | None:
        taken.append(data)
        return long_way(single, data, now)

    monkeypatch.setattr(Single, "reply", noted)
    assert ask() == first
    # Only where the next row has an index of another length; version 2c asks twice over the wire, 3 once.
    last_short = sum(column.rows.indexes[-1] > (127,) for column in columns)
    assert len(taken) == (last_short if kind is NEXT else 0)
    for unit in UNITS:
        pair.site.by_unit[unit].snapshot = online(pair.site.by_unit[unit].map, unit + 1)
    assert ask() != first
    assert agent.counters.internal_errors == 0


def test_what_is_missing_is_said_without_reading_the_request_again(pair: Pair, monkeypatch: pytest.MonkeyPatch) -> None:
    """A cell that another model has, a row that is not there, an object that nobody knows."""
    names = [(*LIVE, 9, 12), (*LIVE, 45, 21), (*LIVE, 9, 99), (*LIVE, 99, 21)]
    steps = [asked(name, GET) for name in names]
    for step in steps:
        pair.wires[0].exchange(pair.datagram(step)[0])
    monkeypatch.setattr(reader, "plain_request", None)
    monkeypatch.setattr(reader, "odd_request", None)
    pair.site.by_unit[12].snapshot = replace(pair.site.by_unit[12].snapshot, state=DeviceState.OFFLINE)
    for step in steps:
        data, poller = pair.datagram(step)
        reply = pair.wires[0].exchange(data)
        assert reply is not None
        _, _, found = meaning(reply, step, poller)  # type: ignore[misc]
        assert [value[:1] in {b"\x80", MISSING[:1]} for _, value in found] == [True]


def test_nothing_is_kept_of_a_cell(pair: Pair) -> None:
    agent = pair.agents[0]
    columns = number_columns(agent)[:60]
    names = [(*column.base, *index) for column in columns for index in column.rows.indexes]
    datagrams = [pair.datagram(asked(name, kind))[0] for name in names for kind in (GET, NEXT)]
    for data in datagrams[: 4 * len(UNITS)]:
        pair.wires[0].exchange(data)
    tracemalloc.start()
    for data in datagrams:
        pair.wires[0].exchange(data)
    kept, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert kept < len(columns) * 4 * 600  # a column, a kind and a length of an index each


class Crowd:
    """A socket in which datagrams of several hosts wait; what goes back to the last host cannot be sent."""

    def __init__(self, waiting: list[tuple[bytes, str]], unreachable: str) -> None:
        self._waiting = waiting[::-1]
        self._unreachable = unreachable
        self.sent: list[str] = []

    def recvfrom(self, _size: int) -> tuple[bytes, tuple[str, int]]:
        if not self._waiting:
            raise BlockingIOError
        data, host = self._waiting.pop()
        return data, (host, 4711)

    def sendto(self, _data: bytes, address: tuple[str, int]) -> None:
        if address[0] == self._unreachable:
            raise OSError
        self.sent.append(address[0])


@pytest.mark.parametrize("known", [True, False])
def test_everybody_has_an_allowance_however_quickly_they_are_answered(
    make_agent: Callable[..., SnmpAgent], clock: StubClock, *, known: bool
) -> None:
    agent = make_agent(requests_per_s=2.0)  # 20 at once
    number, text = request(GET, (*LIVE, 9, 11)), request(GET, SYS_DESCR)
    hosts = ["127.0.0.1", "127.0.0.2", "198.51.100.1", "127.0.0.3"]
    for round_ in range(2):
        clock.now += 1000.0  # everybody may ask again
        waiting = [(data, host) for at in range(15) for host in hosts for data in (number, number if known else text)]
        crowd = Crowd(waiting, hosts[-1])
        while crowd._waiting:
            agent.answer_waiting(cast("socket.socket", crowd))
        assert [crowd.sent.count(host) for host in hosts] == [20, 20, 0, 0]
        counters = agent.counters
        assert counters.responses == 60 * (round_ + 1)
        assert counters.send_failures == 20 * (round_ + 1)
        assert counters.rate_limited == counters.refused_sources == 30 * (round_ + 1)
        assert counters.in_packets == counters.responses + counters.dropped == 120 * (round_ + 1)
