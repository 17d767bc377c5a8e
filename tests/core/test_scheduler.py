"""Whose turn it is: lanes by precedence, none of them starved, polls evenly late, quarantined devices probed only."""

from __future__ import annotations

from itertools import pairwise
from random import Random

import pytest

from gateway.core.budget import read_s
from gateway.core.health import Breaker
from gateway.core.requests import ClientRead, Lane, PollItem, Purpose, ReadTurn, Span, Turn, Waiter, WriteTurn
from gateway.core.scheduler import SLAVE_TURNS, PollList, Scheduler
from gateway.core.settings import LineSettings
from gateway.core.site import Device, Outcome
from gateway.devices.model import PollClass, Space
from gateway.devices.plan import PlannedBlock
from gateway.devices.schema import load_map
from gateway.errors import QueueFull
from gateway.modbus.pdu import Function, ReadRequest

LIVE = PlannedBlock(Space.REGISTERS, 0, 82, PollClass.LIVE)
TIMING = LineSettings(name="line", index=1, port="virtual").timing()


def device(unit_id: int) -> Device:
    return Device(f"array-{unit_id}", unit_id, unit_id, load_map("prostar-mppt"))


def polls(owner: Device, due: float = 0.0, period_s: float | None = 1.0) -> PollList:
    item = PollItem(owner, Purpose.POLL, b"\x03\0\0\0\x52", LIVE, period_s, due)
    return PollList(owner, Breaker(Random(1)), [item])


def no_polls(owner: Device) -> PollList:
    return PollList(owner, Breaker(Random(1)))


def ignore(_outcome: Outcome) -> None:
    pass


def scheduler(*lists: PollList, limit: int = 4, limit_s: float = 5.0) -> Scheduler:
    return Scheduler(
        lists, limit=limit, limit_s=limit_s, cost=lambda space, count: read_s(TIMING, space, count), now=0.0
    )


def read(
    queue: Scheduler,
    owner: Device,
    first: int,
    now: float = 0.0,
    *,
    count: int = 1,
    client: str = "scada",
    lane: Lane = Lane.CLIENT,
) -> Waiter:
    """Queue a read; addresses of 200 and more apart are never joined."""
    waiter = Waiter(ignore, client, now)
    request = ReadRequest(Function.READ_HOLDING_REGISTERS, first, count)
    queue.add_read(owner, request.encode(), Span.of(owner, request), waiter, lane)
    return waiter


def write(queue: Scheduler, owner: Device, lane: Lane, now: float = 0.0) -> WriteTurn:
    turn = WriteTurn(owner, b"\x06\0\x25\0\0", lane, now, Waiter(ignore, "scada", now))
    queue.add_write(turn)
    return turn


def lane_of(turn: Turn | None) -> str:
    if isinstance(turn, PollItem):
        return "poll"
    return "none" if turn is None else turn.lane.name.lower()


def reads_of(turn: Turn | None) -> tuple[ClientRead, ...]:
    assert isinstance(turn, ReadTurn)
    return turn.reads


def run_poll(item: object, now: float) -> None:
    """What the engine does when it starts a poll."""
    assert isinstance(item, PollItem)
    assert item.period_s is not None
    item.due = now + item.period_s


def test_lanes_by_precedence() -> None:
    one = device(1)
    queue = scheduler(polls(one, due=0.0))
    read(queue, one, 0x8000, lane=Lane.BACKGROUND)
    read(queue, one, 0)
    write(queue, one, Lane.WRITE)
    write(queue, one, Lane.SLAVE_CONTROL)
    order = []
    for _ in range(5):
        turn = queue.next(0.1)
        order.append(lane_of(turn))
        if isinstance(turn, PollItem):
            run_poll(turn, 0.1)
    assert order == ["slave_control", "write", "client", "poll", "background"]


def test_clients_that_never_stop_cannot_starve_a_poll_and_the_background_waits() -> None:
    one = device(1)
    queue = scheduler(polls(one, due=0.0), limit=400)
    read(queue, one, 0x8000, lane=Lane.BACKGROUND)
    turns = []
    for step in range(400):
        now = 5.0 + step * 0.25
        read(queue, one, 160 * step, now)
        turn = queue.next(now)
        turns.append(lane_of(turn))
        if isinstance(turn, PollItem):
            run_poll(turn, now)
    assert "poll" in turns[:2]
    assert turns.count("poll") > 40
    assert turns.count("client") > 300
    assert turns.count("background") == 0


def test_writes_that_never_stop_cannot_starve_the_clients() -> None:
    one = device(1)
    queue = scheduler(no_polls(one))
    read(queue, one, 0)
    order = []
    for step in range(8):
        now = 2.0 + 0.1 * step
        write(queue, one, Lane.WRITE, now)
        order.append(lane_of(queue.next(now)))
    assert order.count("client") == 1
    assert order.index("client") <= 1


def test_slave_control_goes_ahead_of_everything_for_a_while_but_not_for_ever() -> None:
    one = device(1)
    queue = scheduler(no_polls(one))
    read(queue, one, 0)
    order = []
    for step in range(10):
        now = 2.0 + 0.1 * step
        write(queue, one, Lane.SLAVE_CONTROL, now)
        order.append(lane_of(queue.next(now)))
    assert order[:SLAVE_TURNS] == ["slave_control"] * SLAVE_TURNS
    assert order.count("client") == 1


def test_a_background_read_waits_until_it_is_over_before_the_next_poll() -> None:
    one = device(1)
    queue = scheduler(polls(one, due=1.0))
    read(queue, one, 0x8000, now=0.0, count=112, lane=Lane.BACKGROUND)
    assert queue.next(0.9) is None
    assert queue.next_due(0.9) == 1.0
    run_poll(queue.next(1.0), 1.0)
    assert queue.next_due(1.25) == 1.25
    assert lane_of(queue.next(1.25)) == "background"


def idle_pieces(share: float, count: int) -> tuple[list[Device], Scheduler, float]:
    """Devices whose polls come at even intervals and take that share of the line; one that a poll takes."""
    owners = [device(unit) for unit in range(1, count + 1)]
    return owners, scheduler(*(polls(owner, due=n / count) for n, owner in enumerate(owners))), share / count


def run_line(queue: Scheduler, poll_s: float, seconds: float) -> tuple[list[str], list[tuple[float, str]]]:
    """Let a line do what is due; gives the lanes, and when which device was polled."""
    now, lanes, polled = 0.0, [], []
    while now < seconds:
        due = queue.next_due(now)
        assert due is not None
        now = max(now, due)
        turn = queue.next(now)
        assert turn is not None, "no turn at the moment it was promised for"
        lanes.append(lane_of(turn))
        if isinstance(turn, PollItem):
            polled.append((now, turn.device.name))
            run_poll(turn, now)
            now += poll_s
        else:
            now += read_s(TIMING, Space.REGISTERS, 16)
    return lanes, polled


@pytest.mark.parametrize("count", [3, 8])
def test_idle_time_in_pieces_is_gathered_for_a_background_read(count: int) -> None:
    owners, queue, poll_s = idle_pieces(0.85, count)
    read(queue, owners[0], 0x8000, now=0.0, count=16, lane=Lane.BACKGROUND)
    lanes, polled = run_line(queue, poll_s, 60.0)
    assert lanes.count("background") == 1
    assert 30 * count <= lanes.index("background") <= 33 * count, "after half a minute"
    for owner in owners:
        moments = [at for at, name in polled if name == owner.name]
        assert max(later - earlier for earlier, later in pairwise(moments)) < 1.001, "no poll is late for it"
        assert len(moments) <= 62, "and hardly one too many was made"


def test_on_a_line_without_idle_time_a_background_read_waits_for_ever() -> None:
    owners, queue, poll_s = idle_pieces(0.97, 3)
    read(queue, owners[0], 0x8000, now=0.0, count=16, lane=Lane.BACKGROUND)
    lanes, polled = run_line(queue, poll_s, 600.0)
    assert "background" not in lanes
    assert len(polled) <= 600 * 3 * 1.04, "polls brought forward in vain are few"


def test_on_a_line_too_slow_all_periods_stretch_alike() -> None:
    owners = [device(unit) for unit in range(1, 6)]
    queue = scheduler(*(polls(owner) for owner in owners))
    turns: list[str] = []
    now = 0.0
    for _ in range(100):
        job = queue.next(now)
        run_poll(job, now)
        assert isinstance(job, PollItem)
        turns.append(job.device.name)
        now += 0.7  # five devices at 1 s each need 3.5 s
    assert {turns.count(owner.name) for owner in owners} == {20}


def test_after_a_pause_there_is_one_round_and_no_burst() -> None:
    one = device(1)
    queue = scheduler(polls(one, due=0.0))
    run_poll(queue.next(1000.0), 1000.0)
    assert queue.next(1000.2) is None
    assert queue.next_due(1000.2) == 1001.0


def test_identical_reads_are_one_read_with_two_waiters() -> None:
    one, two = device(1), device(2)
    queue = scheduler(no_polls(one), no_polls(two))
    read(queue, one, 0)
    read(queue, one, 0)
    read(queue, two, 0)
    assert len(queue) == 2
    (first,) = reads_of(queue.next(0.0))
    assert first.device is one
    assert len(first.waiters) == 2


def test_a_read_that_started_takes_no_new_waiter() -> None:
    """A read that is on the wire began before the second was asked: its value may be older than the question."""
    one = device(1)
    queue = scheduler(no_polls(one))
    read(queue, one, 0)
    (started,) = reads_of(queue.next(0.0))
    read(queue, one, 0)
    assert len(started.waiters) == 1
    assert len(queue) == 1


def test_neighbouring_reads_are_one_transaction() -> None:
    one, two = device(1), device(2)
    queue = scheduler(no_polls(one), no_polls(two))
    read(queue, one, 0x10)
    read(queue, two, 0x11)
    read(queue, one, 0x12)
    turn = queue.next(0.0)
    assert isinstance(turn, ReadTurn)
    assert turn.pdu == ReadRequest(Function.READ_HOLDING_REGISTERS, 0x10, 3).encode()
    assert [one_read.device for one_read in turn.reads] == [one, one]
    assert len(queue) == 1


def test_one_waiter_leaving_takes_nothing_from_the_other() -> None:
    one = device(1)
    queue = scheduler(no_polls(one))
    first = read(queue, one, 0)
    read(queue, one, 0)
    first.cancel()
    assert len(reads_of(queue.next(0.0))) == 1


def test_a_read_that_nobody_wants_any_more_costs_no_line_time() -> None:
    one = device(1)
    queue = scheduler(no_polls(one))
    read(queue, one, 0).cancel()
    assert queue.next_due(0.0) is None
    assert queue.next(0.0) is None
    assert len(queue) == 0


def test_a_write_whose_client_left_is_not_made() -> None:
    one = device(1)
    queue = scheduler(no_polls(one))
    write(queue, one, Lane.WRITE).waiter.cancel()
    assert queue.next_due(0.0) is None
    assert queue.next(0.0) is None


def test_a_full_queue_refuses_but_an_identical_read_may_join_and_the_unwanted_make_room() -> None:
    one = device(1)
    queue = scheduler(no_polls(one), limit=2)
    first = read(queue, one, 0)
    read(queue, one, 200)
    with pytest.raises(QueueFull):
        read(queue, one, 400)
    read(queue, one, 200)
    first.cancel()
    read(queue, one, 400)
    assert len(queue) == 2


def test_a_full_queue_of_writes_refuses() -> None:
    one = device(1)
    queue = scheduler(no_polls(one), limit=2)
    write(queue, one, Lane.WRITE)
    write(queue, one, Lane.WRITE)
    with pytest.raises(QueueFull):
        write(queue, one, Lane.WRITE)


def test_a_read_that_waited_too_long_is_given_up() -> None:
    one = device(1)
    queue = scheduler(no_polls(one), limit_s=5.0)
    first = read(queue, one, 0, now=0.0)
    read(queue, one, 200, now=3.0)
    assert queue.next_expiry() == 5.0
    assert queue.expired(4.9) == []
    assert queue.expired(5.0) == [first]
    assert len(queue) == 1
    assert queue.next_expiry() == 8.0


def test_a_retry_goes_first() -> None:
    one = device(1)
    queue = scheduler(no_polls(one))
    read(queue, one, 0)
    (started,) = reads_of(queue.next(0.0))
    read(queue, one, 200)
    queue.retry(started)
    assert reads_of(queue.next(0.0)) == (started,)


def test_a_quarantined_device_is_asked_only_when_its_probe_is_due() -> None:
    one, two = device(1), device(2)
    dead = polls(one)
    queue = scheduler(dead, polls(two, due=0.5))
    for _ in range(3):
        dead.breaker.missed(0.0)
    turn = queue.next(1.0)
    assert turn is not None
    assert turn.device is two
    run_poll(turn, 1.0)
    assert queue.next(1.5) is None
    assert dead.breaker.probe_at is not None
    run_poll(queue.next(2.5), 100.0)
    probe = queue.next(dead.breaker.probe_at)
    assert probe is not None
    assert probe.device is one


def test_the_requests_of_a_quarantined_device_can_be_taken_out() -> None:
    one, two = device(1), device(2)
    queue = scheduler(no_polls(one), no_polls(two))
    mine = [read(queue, one, 0), read(queue, one, 200), write(queue, one, Lane.WRITE).waiter]
    other = read(queue, two, 0)
    assert queue.drain(one) == mine
    assert queue.drain() == [other]
    assert len(queue) == 0
