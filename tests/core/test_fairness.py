"""A fair share of the line for each client."""

from __future__ import annotations

from collections import Counter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.core.fairness import MAX_CLIENTS, FairQueue
from gateway.core.requests import ClientRead, Lane, Waiter
from gateway.core.site import Device, Outcome
from gateway.devices.schema import load_map
from gateway.errors import QueueFull

DEVICE = Device("array-1", 1, 1, load_map("prostar-mppt"))


def ignore(_outcome: Outcome) -> None:
    pass


def ask(queue: FairQueue, client: str, what: int, now: float = 0.0) -> tuple[Waiter, ClientRead | None]:
    waiter = Waiter(ignore, client, now)
    return waiter, queue.add(DEVICE, what.to_bytes(4, "big"), None, waiter)


def serve(queue: FairQueue, seconds: float = 0.1) -> ClientRead:
    read = queue.head()
    assert read is not None
    clients = read.clients()
    queue.take(read)
    queue.charge(clients, seconds)
    return read


def queue_of(limit: int = 64, limit_s: float = 5.0) -> FairQueue:
    return FairQueue(Lane.CLIENT, limit=limit, limit_s=limit_s)


def test_one_who_asks_for_everything_slows_only_itself() -> None:
    queue = queue_of()
    for what in range(40):
        ask(queue, "greedy", what)
    ask(queue, "modest", 1000)
    served = [serve(queue).clients()[0] for _ in range(3)]
    assert "modest" in served


def test_line_time_is_what_is_shared_not_the_number_of_reads() -> None:
    queue = queue_of()
    spent: Counter[str] = Counter()
    for what in range(30):
        ask(queue, "long", what)
        ask(queue, "short", 1000 + what)
    for _ in range(22):
        read = queue.head()
        assert read is not None
        client = read.clients()[0]
        seconds = 0.25 if client == "long" else 0.025
        serve(queue, seconds)
        spent[client] += int(1000 * seconds)
    assert abs(spent["long"] - spent["short"]) <= 250


def test_idleness_is_not_saved_up() -> None:
    queue = queue_of()
    ask(queue, "late", 1)
    serve(queue)
    for what in range(30):
        ask(queue, "busy", what)
    for _ in range(10):
        serve(queue)
    for what in range(100, 110):
        ask(queue, "late", what)
    served = Counter(serve(queue).clients()[0] for _ in range(10))
    assert served["busy"] >= 4


def test_a_shared_read_goes_with_whoever_has_its_turn_first() -> None:
    queue = queue_of()
    for what in range(20):
        ask(queue, "greedy", what)
    ask(queue, "modest", 19)  # what the greedy one asked for last
    served = [serve(queue) for _ in range(3)]
    assert any(set(read.clients()) == {"greedy", "modest"} for read in served)


def test_when_the_queue_is_full_the_greediest_gives_way_to_the_modest() -> None:
    queue = queue_of(limit=10)
    for what in range(10):
        ask(queue, "greedy", what)
    with pytest.raises(QueueFull):
        ask(queue, "greedy", 99)
    _, loser = ask(queue, "modest", 1000)
    assert loser is not None
    assert loser.clients() == ["greedy"]
    assert len(queue) == 10


def test_clients_that_came_and_went_are_forgotten() -> None:
    queue = queue_of()
    for number in range(10 * MAX_CLIENTS):
        ask(queue, f"client-{number}", number)
        serve(queue)
    assert len(queue._shares) <= MAX_CLIENTS + 1


def test_each_asker_waits_its_own_time() -> None:
    queue = queue_of(limit_s=5.0)
    first, _ = ask(queue, "one", 1, now=0.0)
    second, _ = ask(queue, "two", 1, now=4.0)
    assert queue.expired(5.0) == [first]
    assert len(queue) == 1
    assert queue.expired(9.0) == [second]
    assert len(queue) == 0
    assert queue.head() is None


@given(st.lists(st.tuples(st.sampled_from("abc"), st.integers(0, 5), st.booleans()), max_size=60))
def test_nobody_is_lost_and_nobody_is_served_twice(steps: list[tuple[str, int, bool]]) -> None:
    queue = queue_of(limit=6, limit_s=1e9)
    open_waiters: set[Waiter] = set()
    ended: list[Waiter] = []
    for client, what, serve_one in steps:
        try:
            waiter, loser = ask(queue, client, what)
        except QueueFull:
            pass
        else:
            open_waiters.add(waiter)
            ended += [] if loser is None else loser.waiters
        if serve_one and queue.head() is not None:
            ended += serve(queue).waiters
    while queue.head() is not None:
        ended += serve(queue).waiters
    assert len(ended) == len(set(ended))
    assert set(ended) == open_waiters
    assert len(queue) == 0
