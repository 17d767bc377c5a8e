"""Whose turn it is: clients before polls, polls not starved, identical reads shared."""

from __future__ import annotations

from random import Random

import pytest

from gateway.core.health import Breaker
from gateway.core.scheduler import ClientRead, PollItem, PollList, Purpose, Scheduler, Waiter
from gateway.core.site import Device, Outcome
from gateway.devices.model import PollClass, Space
from gateway.devices.plan import PlannedBlock
from gateway.devices.schema import load_map
from gateway.errors import QueueFull

LIVE = PlannedBlock(Space.REGISTERS, 0, 82, PollClass.LIVE)


def device(unit_id: int) -> Device:
    return Device(f"array-{unit_id}", unit_id, unit_id, load_map("prostar-mppt"))


def polls(owner: Device, due: float = 0.0, period_s: float | None = 1.0) -> PollList:
    item = PollItem(owner, Purpose.POLL, b"\x03\0\0\0\x52", LIVE, period_s, due)
    return PollList(owner, Breaker(Random(1)), [item])


def ignore(_outcome: Outcome) -> None:
    pass


def scheduler(*lists: PollList, limit: int = 4, limit_s: float = 5.0) -> Scheduler:
    return Scheduler(lists, limit=limit, limit_s=limit_s)


def read(queue: Scheduler, owner: Device, pdu: bytes, now: float = 0.0) -> Waiter:
    waiter = Waiter(ignore)
    queue.add(owner, pdu, waiter, now)
    return waiter


def run_poll(item: object, now: float) -> None:
    """What the engine does when it starts a poll."""
    assert isinstance(item, PollItem)
    assert item.period_s is not None
    item.due = now + item.period_s


def test_a_client_goes_before_a_poll_that_is_due() -> None:
    one = device(1)
    queue = scheduler(polls(one, due=0.0))
    read(queue, one, b"a")
    assert isinstance(queue.next(0.5), ClientRead)
    assert isinstance(queue.next(0.5), PollItem)


def test_clients_that_never_stop_cannot_starve_a_poll() -> None:
    one = device(1)
    queue = scheduler(polls(one, due=0.0))
    turns = []
    for step in range(20):
        now = 5.0 + step * 0.2
        read(queue, one, bytes([step]), now)
        job = queue.next(now)
        turns.append(type(job).__name__)
        if isinstance(job, PollItem):
            run_poll(job, now)
    assert turns.count("PollItem") >= 2
    assert turns.count("ClientRead") >= 15
    assert "PollItem" in turns[:2]


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
    queue = scheduler()
    read(queue, one, b"a")
    read(queue, one, b"a")
    read(queue, two, b"a")
    assert len(queue) == 2
    first = queue.next(0.0)
    assert isinstance(first, ClientRead)
    assert first.device is one
    assert len(first.waiters) == 2


def test_a_read_that_started_takes_no_new_waiter() -> None:
    """A read that is on the wire began before the second was asked: its value may be older than the question."""
    one = device(1)
    queue = scheduler()
    read(queue, one, b"a")
    started = queue.next(0.0)
    read(queue, one, b"a")
    assert isinstance(started, ClientRead)
    assert len(started.waiters) == 1
    assert len(queue) == 1


def test_one_waiter_leaving_takes_nothing_from_the_other() -> None:
    one = device(1)
    queue = scheduler()
    first = read(queue, one, b"a")
    read(queue, one, b"a")
    first.cancel()
    assert isinstance(queue.next(0.0), ClientRead)


def test_a_read_that_nobody_wants_any_more_costs_no_line_time() -> None:
    one = device(1)
    queue = scheduler()
    read(queue, one, b"a").cancel()
    assert queue.next_due(0.0) is None
    assert queue.next(0.0) is None
    assert len(queue) == 0


def test_a_full_queue_refuses_but_an_identical_read_may_join_and_the_unwanted_make_room() -> None:
    one = device(1)
    queue = scheduler(limit=2)
    first = read(queue, one, b"a")
    read(queue, one, b"b")
    with pytest.raises(QueueFull):
        read(queue, one, b"c")
    read(queue, one, b"b")
    first.cancel()
    read(queue, one, b"c")
    assert len(queue) == 2


def test_a_read_that_waited_too_long_is_given_up() -> None:
    one = device(1)
    queue = scheduler(limit_s=5.0)
    read(queue, one, b"a", now=0.0)
    read(queue, one, b"b", now=3.0)
    assert queue.next_expiry() == 5.0
    assert queue.expired(4.9) == []
    assert [waiting.pdu for waiting in queue.expired(5.0)] == [b"a"]
    assert len(queue) == 1


def test_a_retry_goes_first() -> None:
    one = device(1)
    queue = scheduler()
    read(queue, one, b"a")
    started = queue.next(0.0)
    read(queue, one, b"b")
    assert isinstance(started, ClientRead)
    queue.retry(started)
    assert queue.next(0.0) is started


def test_a_quarantined_device_is_asked_only_when_its_probe_is_due() -> None:
    one, two = device(1), device(2)
    dead = polls(one)
    queue = scheduler(dead, polls(two, due=0.5))
    for _ in range(3):
        dead.breaker.missed(0.0)
    job = queue.next(1.0)
    assert isinstance(job, PollItem)
    assert job.device is two
    run_poll(job, 1.0)
    assert queue.next(1.5) is None
    assert dead.breaker.probe_at is not None
    probe = queue.next(dead.breaker.probe_at)
    run_poll(queue.next(9.0), 9.0)
    assert isinstance(probe, PollItem)


def test_the_reads_of_a_quarantined_device_can_be_taken_out() -> None:
    one, two = device(1), device(2)
    queue = scheduler()
    read(queue, one, b"a")
    read(queue, two, b"a")
    read(queue, one, b"b")
    assert [taken.pdu for taken in queue.take_device(one)] == [b"a", b"b"]
    assert [taken.device for taken in queue.drain()] == [two]
    assert len(queue) == 0
