"""The line in virtual time: pacing, frames by silence, gaps, collisions, faults on demand."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.devices.model import DeviceMap
from gateway.devices.schema import load_map
from gateway.modbus.crc import append_crc, crc_ok
from gateway.modbus.rtu import Timing
from gateway.simulator.device import SimulatedController
from gateway.simulator.line import SimulatedLine
from gateway.simulator.medium import Burst, CleanMedium
from gateway.simulator.oracle import OracleController

CHAR = 11 / 9600
GAP = 3.5 * CHAR


def read(address: int, first: int = 0, count: int = 82) -> bytes:
    return append_crc(bytes([address, 3, *first.to_bytes(2, "big"), *count.to_bytes(2, "big")]))


def run(line: SimulatedLine, until: float) -> list[tuple[float, bytes]]:
    """What arrives up to `until`, each piece with its time."""
    arrived = []
    while (due := line.next_event()) is not None and due <= until:
        data = line.take(due)
        if data:
            arrived.append((due, data))
    return arrived


def reply_of(line: SimulatedLine, request: bytes, now: float) -> tuple[bytes, float]:
    """The whole reply and when its last byte arrived."""
    line.receive(request, now)
    arrived = run(line, now + 10.0)
    return b"".join(data for _, data in arrived), arrived[-1][0] if arrived else math.nan


@pytest.fixture
def oracle(prostar_map: DeviceMap) -> OracleController:
    return OracleController(prostar_map, turnaround_s=0.015)


@pytest.fixture
def line(oracle: OracleController) -> SimulatedLine:
    return SimulatedLine([oracle])


def test_a_read_takes_its_wire_time_both_ways_and_the_turnaround(line: SimulatedLine) -> None:
    reply, at = reply_of(line, read(1), 100.0)
    assert crc_ok(reply)
    assert len(reply) == 169
    assert at == pytest.approx(100.0 + 8 * CHAR + GAP + 0.015 + 169 * CHAR, abs=1e-6)


def test_reply_bytes_arrive_one_after_the_other(line: SimulatedLine) -> None:
    line.receive(read(1), 0.0)
    start = 8 * CHAR + GAP + 0.015
    assert line.take(start + 0.999 * CHAR) == b""
    received = b""
    for k in range(1, 170):
        received += line.take(start + k * CHAR)
        assert len(received) == k
    assert crc_ok(received)
    assert line.next_event() is None


def test_events_wake_for_chunks_and_exactly_at_the_end(oracle: OracleController) -> None:
    line = SimulatedLine([oracle], wake_bytes=16)
    line.receive(read(1), 0.0)
    arrived = run(line, 1.0)
    assert [len(data) for _, data in arrived] == [16] * 10 + [9]
    assert arrived[-1][0] == pytest.approx(8 * CHAR + GAP + 0.015 + 169 * CHAR, abs=1e-6)


def test_a_request_in_pieces_is_one_frame_while_the_silence_is_short(line: SimulatedLine) -> None:
    request = read(1)
    line.receive(request[:3], 0.0)
    line.receive(request[3:], 3 * CHAR + 0.9 * GAP)
    assert crc_ok(b"".join(data for _, data in run(line, 1.0)))


def test_a_silence_of_three_and_a_half_characters_ends_a_frame(line: SimulatedLine) -> None:
    request = read(1)
    line.receive(request[:3], 0.0)
    line.receive(request[3:], 3 * CHAR + 1.1 * GAP)
    assert run(line, 1.0) == []
    assert line.counters.bad_frames == 2
    assert line.counters.gap_violations == 0


def test_two_requests_without_a_gap_are_heard_by_nobody(line: SimulatedLine) -> None:
    assert reply_of(line, read(1) + read(1), 0.0)[0] == b""
    assert line.counters.bad_frames == 1


def test_the_gap_before_a_request_is_measured(line: SimulatedLine) -> None:
    _, at = reply_of(line, read(1), 0.0)
    _, at = reply_of(line, read(1), at + GAP)
    assert line.counters.gap_violations == 0
    assert line.counters.shortest_gap_s == pytest.approx(GAP, abs=1e-6)
    reply, _ = reply_of(line, read(1), at + 0.9 * GAP)
    assert crc_ok(reply)
    assert line.counters.gap_violations == 1
    assert line.counters.shortest_gap_s == pytest.approx(0.9 * GAP, abs=1e-6)


def test_a_request_while_a_reply_is_on_the_wire_is_a_collision(line: SimulatedLine) -> None:
    line.receive(read(1), 0.0)
    line.take(0.1)
    line.receive(read(1), 0.1)
    run(line, 2.0)
    assert line.counters.collisions == 1
    assert line.counters.gap_violations == 0


def test_a_reply_that_starts_under_a_request_is_a_collision(line: SimulatedLine) -> None:
    line.receive(read(1), 0.0)
    line.receive(read(1), 8 * CHAR + GAP + 0.010)
    run(line, 2.0)
    assert line.counters.collisions == 1


def test_a_station_works_on_one_request_at_a_time(line: SimulatedLine, oracle: OracleController) -> None:
    oracle.turnaround_s = 0.5
    line.receive(read(1, 0, 1), 0.0)
    line.receive(read(1, 1, 1), 0.1)
    times = [at for at, _ in run(line, 5.0)]
    first_end = 8 * CHAR + GAP + 0.5 + 7 * CHAR
    assert times == pytest.approx([first_end, first_end + 0.5 + 7 * CHAR], abs=1e-6)


def test_broadcasts_are_ignored(line: SimulatedLine, oracle: OracleController) -> None:
    assert reply_of(line, append_crc(bytes([0, 6, 0xE0, 0, 0, 1])), 0.0)[0] == b""
    assert line.counters.broadcasts == 1
    assert oracle.writes == []


def test_nobody_answers_for_an_absent_address(line: SimulatedLine) -> None:
    assert reply_of(line, read(9), 0.0)[0] == b""
    assert line.counters.unanswered == 1


def test_two_stations_with_one_address_spoil_each_others_reply(prostar_map: DeviceMap) -> None:
    line = SimulatedLine([OracleController(prostar_map, device=k, address=1) for k in range(2)])
    reply, _ = reply_of(line, read(1), 0.0)
    assert len(reply) == 169
    assert not crc_ok(reply)


def test_a_station_moves_to_its_new_address_after_its_reset(prostar_map: DeviceMap) -> None:
    unit = SimulatedController(prostar_map)
    line = SimulatedLine([unit])
    (address,) = [point.address for point in prostar_map.points if point.name == "modbus_id"]
    write = append_crc(bytes([1, 6, *address.to_bytes(2, "big"), 0, 5]))
    assert reply_of(line, write, 0.0)[0] == write
    assert reply_of(line, append_crc(bytes([1, 5, 0x00, 0xFF, 0xFF, 0x00])), 1.0)[0] == b""
    assert reply_of(line, read(1), 10.0)[0] == b""
    assert reply_of(line, read(5), 11.0)[0][0] == 5


def test_replies_can_be_corrupted_and_delayed(line: SimulatedLine) -> None:
    line.corrupt_replies(2)
    assert [crc_ok(reply_of(line, read(1), 10.0 * k)[0]) for k in range(3)] == [False, False, True]
    line.delay_reply(0.7)
    _, late = reply_of(line, read(1), 100.0)
    _, normal = reply_of(line, read(1), 200.0)
    assert late - 100.0 == pytest.approx(normal - 200.0 + 0.7, abs=1e-6)


def test_a_medium_can_echo_and_drop(oracle: OracleController) -> None:
    class Lossy(CleanMedium):
        def echo(self, frame: bytes, started_at: float) -> Sequence[Burst]:
            return (Burst(started_at, frame),)

        def reply(self, frame: bytes, starts_at: float) -> Sequence[Burst]:
            return ()

    line = SimulatedLine([oracle], medium=Lossy())
    assert reply_of(line, read(1), 0.0)[0] == read(1)

    class Deaf(CleanMedium):
        def request(self, frame: bytes, ended_at: float) -> bytes:
            return b""

    line = SimulatedLine([oracle], medium=Deaf())
    assert reply_of(line, read(1), 0.0)[0] == b""
    assert line.counters.requests == 0


def test_clearing_forgets_both_directions(line: SimulatedLine) -> None:
    line.receive(read(1), 0.0)
    line.take(0.1)
    line.receive(read(1)[:4], 0.1)
    line.clear()
    assert line.next_event() is None
    collisions = line.counters.collisions
    assert crc_ok(reply_of(line, read(1), 0.11)[0])
    assert line.counters.collisions == collisions


def test_line_use_counts_bytes_and_their_gaps(prostar_map: DeviceMap) -> None:
    line = SimulatedLine([OracleController(prostar_map, turnaround_s=0.0)])
    now = 0.0
    for _ in range(10):
        _, at = reply_of(line, read(1), now)
        now = at + GAP
    assert now == pytest.approx(10 * 0.2108, abs=0.001)
    assert line.use_ratio(now) == pytest.approx(1.0, abs=0.001)
    assert line.use_ratio(2 * now) == pytest.approx(0.5, abs=0.001)


def test_other_timings_are_kept(oracle: OracleController) -> None:
    line = SimulatedLine([oracle], timing=Timing.of(19200, 8, "E", 1))
    _, at = reply_of(line, read(1), 0.0)
    assert at == pytest.approx(177 * 11 / 19200 + 3.5 * 11 / 19200 + 0.015, abs=1e-6)


def test_an_hour_of_three_controllers_polled_back_to_back(prostar_map: DeviceMap) -> None:
    units = [SimulatedController(prostar_map, address=k + 1, seed=k) for k in range(3)]
    line = SimulatedLine(units)
    now, replies = 0.0, 0
    while now < 3600.0:
        reply, at = reply_of(line, read(1 + replies % 3), now)
        assert crc_ok(reply)
        replies += 1
        now = at + GAP
    assert replies == pytest.approx(3600 / (0.2108 + 0.015), abs=3)
    assert line.counters.gap_violations == line.counters.collisions == line.counters.bad_frames == 0
    assert line.counters.replies == replies


@given(pieces=st.lists(st.tuples(st.binary(max_size=300), st.floats(0, 0.5)), max_size=12))
def test_noise_never_breaks_the_line(pieces: list[tuple[bytes, float]]) -> None:
    line = SimulatedLine([OracleController(load_map("prostar-mppt"))])
    now = 0.0
    for data, pause in pieces:
        line.receive(data, now)
        now += pause
        line.take(now)
    now += 60.0
    run(line, now)
    assert line.next_event() is None
    reply, _ = reply_of(line, read(1), now)
    assert crc_ok(reply)
    assert len(reply) == 169


@given(cuts=st.lists(st.integers(1, 7), max_size=5), offset=st.floats(0, 1e6))
def test_the_reply_does_not_depend_on_how_the_request_was_cut(cuts: list[int], offset: float) -> None:
    line = SimulatedLine([OracleController(load_map("prostar-mppt"))])
    request = read(1)
    edges = [0, *sorted(set(cuts)), len(request)]
    for start, end in pairwise(edges):
        line.receive(request[start:end], offset + start * CHAR)
    reply = b"".join(data for _, data in run(line, offset + 1.0))
    assert crc_ok(reply)
    assert len(reply) == 169
