"""A line that carries several transactions at once, in virtual time."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import pytest

from gateway.core.budget import line_budget
from gateway.core.identity import Identity
from gateway.core.requests import Lane
from gateway.core.settings import PollSettings
from gateway.core.site import Device, Outcome
from gateway.core.snapshot import IDENTITY_MISMATCH, DeviceState
from gateway.devices.plan import poll_plan
from gateway.devices.schema import load_map
from gateway.errors import IdentityUnproven, LineDown, RelayedSilence, ReplyTimeout
from gateway.modbus.pdu import Function, ReadRequest, exception_reply
from gateway.simulator.device import SimulatedController
from gateway.simulator.plant import plants_of
from gateway.simulator.upstream import Habits, SimulatedServer
from tests.core.test_engine import Registers, registers
from tests.core.virtual_upstream import VirtualUpstream, make_upstream
from tests.faults.rig import oracle_map

QUIET = PollSettings(live_s=3600.0, settings_s=3600.0)
BUSY = PollSettings(live_s=0.2, settings_s=3600.0)


class Unit(Registers):
    """Also answers writes, and keeps them."""

    def __init__(self, address: int, base: int = 0, turnaround_s: float = 0.0) -> None:
        super().__init__(address, base, turnaround_s)
        self.value = 0

    def handle(self, pdu: bytes, now: float) -> bytes | None:
        if pdu[0] == Function.WRITE_SINGLE_REGISTER and not self.silent:
            self.asked.append(pdu)
            self.value = int.from_bytes(pdu[3:5], "big")
            return pdu
        reply = super().handle(pdu, now)
        if reply is not None and pdu[:3] == bytes.fromhex("03E000") and reply[0] < 0x80:
            return reply[:2] + self.value.to_bytes(2, "big") + reply[4:]
        return reply


def line(
    *units: Unit,
    habits: Habits | None = None,
    run_s: float = 2.0,
    pipelining: int = 8,
    connections: int = 1,
    **settings: object,
) -> VirtualUpstream:
    server = SimulatedServer(units, habits=habits or Habits(latency_s=0.05))
    devices = [Device(f"array-{u.address}", 10 + u.address, u.address, oracle_map()) for u in units]
    settings.setdefault("poll", QUIET)
    rig = make_upstream(server, devices, pipelining=pipelining, connections=connections, **settings)
    rig.run(run_s)
    return rig


def states(rig: VirtualUpstream) -> list[DeviceState]:
    return [device.snapshot.state for device in rig.devices]


def ask_many(rig: VirtualUpstream, count: int, unit: int = 0) -> list[Outcome]:
    """So many reads of different registers, at once."""
    outcomes: list[Outcome] = []
    for k in range(count):
        rig.read(unit, registers(200 * k + 0x100, 1), outcomes.append, client=f"client-{k}")
    return outcomes


def test_requests_overlap_as_far_as_the_window_allows() -> None:
    rig = line(Unit(1), Unit(2))
    assert states(rig) == [DeviceState.ONLINE] * 2
    began = rig.now
    outcomes = ask_many(rig, 16)
    rig.run(0.15)
    assert len(outcomes) == 16, f"two windows of 8, 50 ms each; {rig.now - began}"
    assert rig.most_under_way == 8
    assert rig.engine.stats.opens == rig.engine.upstream.connections == 1


def test_a_server_that_closes_is_asked_over_several_connections_where_that_is_configured() -> None:
    took: dict[int, float] = {}
    for connections in (1, 4):
        rig = line(
            Unit(1), Unit(2), habits=Habits(closes=True, latency_s=0.05), connections=connections, run_s=5.0, poll=BUSY
        )
        outcomes, others = ask_many(rig, 16), ask_many(rig, 16, unit=1)
        began = rig.now
        while len(outcomes) + len(others) < 32:
            rig.run(0.01)
        took[connections] = rig.now - began
        rig.run(2.0)
        assert rig.server.counters.most_open == rig.most_under_way == connections
        assert set(rig.engine.stats.failed) <= {"exception"}
        assert set(rig.engine.upstream.lost) == {"finished"}
        assert states(rig) == [DeviceState.ONLINE] * 2
    assert took[4] < took[1] / 2


def test_a_server_that_admits_one_connection_goes_on_with_it() -> None:
    rig = line(Unit(1), Unit(2), habits=Habits(latency_s=0.05, admits=1), connections=4, pipelining=1)
    outcomes = ask_many(rig, 16)
    rig.run(3.0)
    assert [type(outcome) for outcome in outcomes] == [bytes] * 16
    assert rig.engine.stats.failed["connection_lost"] == 1, "and that one was made again"
    assert [device.stats.failures for device in rig.devices] == [0, 0]
    assert rig.engine.upstream.window == 1
    assert states(rig) == [DeviceState.ONLINE] * 2


def test_without_pipelining_one_follows_the_other() -> None:
    rig = line(Unit(1), Unit(2), pipelining=1)
    ask_many(rig, 16)
    rig.run(2.0)
    assert rig.most_under_way == 1


def test_a_server_that_answers_one_at_a_time_is_found_out_and_no_device_pays_for_it() -> None:
    rig = line(Unit(1), Unit(2), habits=Habits(one_at_a_time=True, latency_s=0.02), retries=0, reply_timeout_s=0.5)
    outcomes = ask_many(rig, 16)
    rig.run(4.0)
    assert [type(outcome) for outcome in outcomes] == [bytes] * 16
    assert rig.engine.upstream.window == 1
    assert [device.stats.went_offline for device in rig.devices] == [0, 0]
    before = rig.engine.stats.failed.total()
    ask_many(rig, 16)
    rig.run(3.0)
    assert rig.engine.stats.failed.total() == before


def test_each_second_of_the_line_is_booked_once() -> None:
    rig = line(Unit(1), Unit(2))
    stats = rig.engine.stats
    ask_many(rig, 40)
    rig.run(5.0)
    assert stats.busy_s == pytest.approx(sum(stats.seconds_by_purpose.values()))
    assert stats.busy_s == pytest.approx(sum(device.stats.line_s for device in rig.devices))
    assert stats.seconds_by_purpose["client"] == pytest.approx(sum(stats.seconds_by_client.values()))
    assert stats.sent == stats.ok + stats.failed.total()
    assert stats.seconds_by_purpose["client"] < 0.5, "40 reads of 50 ms each, eight at a time"


@pytest.mark.parametrize(("closes", "connections"), [(False, 1), (False, 3), (True, 1), (True, 4)])
def test_a_write_is_alone_with_its_device_and_no_read_brings_the_old_value_back(closes: bool, connections: int) -> None:
    unit, other = Unit(1), Unit(2)
    habits = Habits(closes=closes, latency_s=0.05)
    rig = line(unit, other, writes=True, habits=habits, connections=connections, poll=BUSY, run_s=5.0)
    outcomes = ask_many(rig, 6)
    others = ask_many(rig, 2, unit=1)
    written: list[Outcome] = []
    rig.engine.write(rig.devices[0], bytes.fromhex("06E0000007"), written.append, rig.now, client="")
    after: list[Outcome] = []
    rig.read(0, registers(0xE000, 2), after.append)
    rig.run(3.0)
    assert written == [bytes.fromhex("06E0000007")]
    assert isinstance(after[0], bytes)
    assert after[0][2:4] == b"\0\7"
    assert len(outcomes) == 6
    assert len(others) == 2
    times = [(at, adu) for at, adu in rig.sent if adu.unit == 1]
    write_at = next(at for at, adu in times if adu.pdu[0] == 6)
    around = [at for at, adu in times if adu.pdu[0] != 6 and abs(at - write_at) < 0.049]
    assert not around, "nothing of the device overlaps with it"
    assert Counter(adu.pdu[0] for _, adu in rig.sent)[6] == 1


def test_a_dead_device_behind_a_gateway_costs_the_others_nothing() -> None:
    dead = Unit(2)
    habits = Habits(patience_s=0.05, latency_s=0.05)
    rig = line(Unit(1), dead, Unit(3), habits=habits, poll=PollSettings(live_s=1.0, settings_s=3600.0))
    assert states(rig) == [DeviceState.ONLINE] * 3
    dead.silent = True
    rig.run(60.0)
    assert states(rig) == [DeviceState.ONLINE, DeviceState.OFFLINE, DeviceState.ONLINE]
    assert rig.engine.upstream.connections == 1
    assert rig.devices[0].stats.refresh_s == pytest.approx(1.0, rel=0.1)
    assert rig.units_asked()[2] < rig.units_asked()[1] / 3, "it is asked seldom"
    dead.silent = False
    rig.run(60.0)
    assert states(rig) == [DeviceState.ONLINE] * 3


def test_a_dead_device_that_the_server_says_nothing_of_costs_the_others_little() -> None:
    dead = Unit(2)
    habits = Habits(silence=None, patience_s=0.1, latency_s=0.02)
    rig = line(Unit(1), dead, Unit(3), habits=habits, poll=PollSettings(live_s=1.0, settings_s=3600.0))
    dead.silent = True
    rig.run(120.0)
    assert states(rig) == [DeviceState.ONLINE, DeviceState.OFFLINE, DeviceState.ONLINE]
    assert rig.devices[0].stats.refresh_s == pytest.approx(1.0, rel=0.15)
    assert [device.stats.went_offline for device in rig.devices] == [0, 1, 0]


def test_what_was_under_way_together_is_one_miss() -> None:
    rig = line(Unit(1), habits=Habits(patience_s=0.01))
    ask_many(rig, 16)
    rig.run(2.0)
    rig.server.stations.clear()
    outcomes = ask_many(rig, 8)
    rig.run(1.0)
    assert [type(outcome) for outcome in outcomes] == [RelayedSilence] * 8
    assert states(rig) == [DeviceState.ONLINE]


def test_a_server_that_answers_nobody_is_down_and_not_each_of_its_controllers() -> None:
    rig = line(*(Unit(address) for address in range(1, 11)), poll=PollSettings(live_s=1.0, settings_s=3600.0))
    rig.server.habits = Habits(silence=None)
    stations = list(rig.server.stations)
    rig.server.stations.clear()
    rig.run(5.0)
    assert set(states(rig)) == {DeviceState.STALE}
    assert isinstance(rig.ask(0, registers(0x300, 1)), LineDown)
    assert sum(device.stats.went_offline for device in rig.devices) == 0
    rig.server.stations += stations
    rig.run(5.0)
    assert set(states(rig)) == {DeviceState.ONLINE}


@pytest.mark.parametrize(("code", "label"), [(0x0A, 0x0A), (0x0B, 0x0B)])
def test_what_a_gateway_says_of_a_device_is_the_answer_and_counts_as_silence(code: int, label: int) -> None:
    rig = line(Unit(1), habits=Habits(silence=code, patience_s=0.01))
    rig.server.stations.clear()
    outcome = rig.ask(0, registers(0x300, 1))
    assert isinstance(outcome, ReplyTimeout)
    assert outcome.exception_code == label
    for _ in range(3):
        rig.ask(0, registers(0x300, 1))
    assert states(rig) == [DeviceState.OFFLINE]


def test_a_write_that_the_gateway_got_no_answer_to_is_unknown() -> None:
    rig = line(Unit(1), writes=True, habits=Habits(silence=0x0B, patience_s=0.01))
    rig.server.stations.clear()
    outcome = rig.write(0, bytes.fromhex("06E0000007"))
    assert isinstance(outcome, ReplyTimeout)
    assert Counter(adu.pdu[0] for _, adu in rig.sent)[6] == 1


def test_a_write_on_a_connection_that_is_lost_is_not_made_again() -> None:
    unit = Unit(1)
    rig = line(unit, writes=True)
    written: list[Outcome] = []
    rig.engine.write(rig.devices[0], bytes.fromhex("06E0000007"), written.append, rig.now, client="")
    rig.run(0.01)
    rig.reset()
    rig.run(5.0)
    assert len(written) == 1
    assert isinstance(written[0], ReplyTimeout)
    assert [pdu for pdu in unit.asked if pdu[0] == 6] == [bytes.fromhex("06E0000007")]


def test_reads_on_a_connection_that_is_lost_are_made_again_and_nobody_notices() -> None:
    rig = line(Unit(1), Unit(2))
    outcomes = ask_many(rig, 8)
    rig.run(0.01)
    rig.reset()
    rig.run(3.0)
    assert [type(outcome) for outcome in outcomes] == [bytes] * 8
    assert states(rig) == [DeviceState.ONLINE] * 2
    assert [device.stats.failures for device in rig.devices] == [0, 0]


def test_a_server_that_is_gone_takes_the_line_down_and_everything_is_read_anew() -> None:
    rig = line(Unit(1))
    outcomes = ask_many(rig, 8)
    rig.server.refusing = True
    rig.run(0.01)
    rig.reset()
    rig.run(1.0)
    assert {type(outcome) for outcome in outcomes} == {LineDown}
    assert states(rig) == [DeviceState.STALE]
    rig.server.refusing = False
    rig.run(3.0)
    assert states(rig) == [DeviceState.ONLINE]
    assert rig.engine.stats.opens == 2


def test_reads_are_joined_where_they_overlap_and_holes_are_left_alone() -> None:
    rig = line(Unit(1), pipelining=1)
    rig.sent.clear()
    for first, count in ((0, 10), (5, 10), (20, 5), (25, 5)):
        rig.read(0, registers(first, count), lambda _: None)
    rig.run(1.0)
    asked = [ReadRequest(3, *(int.from_bytes(adu.pdu[k : k + 2], "big") for k in (1, 3))) for _, adu in rig.sent]
    assert sorted((read.address, read.count) for read in asked) == [(0, 15), (20, 5), (25, 5)]


@pytest.mark.parametrize("silence", [None, 0x0B])
def test_every_read_ends_within_the_printed_deadline(silence: int | None) -> None:
    units = [Unit(address) for address in range(1, 9)]
    rig = line(*units, habits=Habits(silence=silence, patience_s=0.2, latency_s=0.01), run_s=4.0)
    for unit in units:
        unit.silent = True
    ended: list[float] = []
    for index in range(8):
        for k in range(8):
            rig.engine.read(
                rig.devices[index],
                registers(200 * k, 125),
                lambda _: ended.append(rig.now),
                rig.now,
                client=f"client-{k}",
                lane=Lane.CLIENT,
            )
    began = rig.now
    rig.run(90.0)
    assert len(ended) == 64
    assert max(ended) - began <= line_budget(rig.engine.settings, []).reply_deadline_s


def test_another_controller_behind_a_server_that_was_away_is_not_taken_for_the_old_one() -> None:
    prostar = load_map("prostar-mppt")
    server = SimulatedServer([SimulatedController(prostar, address=1, seed=0)], habits=Habits(closes=True))
    rig = make_upstream(server, [Device("array-1", 11, 1, prostar)])
    rig.run(5.0)
    assert states(rig) == [DeviceState.ONLINE]
    server.refusing = True
    rig.reset()
    rig.run(5.0)
    server.stations[:] = [SimulatedController(prostar, address=1, seed=1)]
    server.refusing = False
    rig.run(5.0)
    assert DeviceState.ONLINE not in states(rig)
    assert IDENTITY_MISMATCH in rig.devices[0].snapshot.warnings
    assert isinstance(rig.ask(0, registers(0, 10)), IdentityUnproven)
    assert rig.devices[0].snapshot.shown() == {}


@pytest.mark.parametrize("latency_s", [0.05, 0.4])
def test_what_is_under_way_when_another_controller_is_looked_at_again_ends_in_peace(latency_s: float) -> None:
    """Its replies belong to a plan that is gone."""
    prostar = load_map("prostar-mppt")

    class Other(SimulatedController):
        def handle(self, pdu: bytes, now: float) -> bytes | None:
            return exception_reply(pdu[0], 2) if pdu[1:2] == b"\xe0" or pdu[0] == 1 else super().handle(pdu, now)

    server = SimulatedServer([Other(prostar)], habits=Habits(latency_s=latency_s))
    device = Device("array-1", 11, 1, prostar, expected=Identity(product="PS-MPPT-99"))
    rig = make_upstream(server, [device], pipelining=8, poll=PollSettings(live_s=0.2, settings_s=1.0))
    rig.run(600.0)
    assert IDENTITY_MISMATCH in device.snapshot.warnings
    server.stations[:] = [SimulatedController(prostar, plant=replace(plants_of(prostar)[0], product="PS-MPPT-99"))]
    rig.run(70.0)
    assert states(rig) == [DeviceState.ONLINE]
    assert {(block.first, block.count) for block in device.snapshot.blocks} == {
        (block.first, block.count) for block in poll_plan(prostar)
    }


def test_a_block_that_the_unit_does_not_have_may_be_under_way_when_it_tells_its_product() -> None:
    """A TriStar without Ethernet, behind a converter that is asked for everything at once."""
    tristar = load_map("tristar-mppt")
    without, _ = plants_of(tristar)
    units = [SimulatedController(tristar, address=address, plant=without, seed=address) for address in (1, 2)]
    server = SimulatedServer(units, habits=Habits(latency_s=0.05))
    devices = [Device(f"array-{unit.address}", 10 + unit.address, unit.address, tristar) for unit in units]
    rig = make_upstream(server, devices, pipelining=8, poll=BUSY)
    rig.run(30.0)
    assert rig.engine.stats.upstream is not None
    assert rig.engine.stats.upstream.window == 8
    server.refusing = True
    rig.reset()
    rig.run(5.0)
    server.refusing = False
    rig.run(30.0)
    assert states(rig) == [DeviceState.ONLINE] * 2
