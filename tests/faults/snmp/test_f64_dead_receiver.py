"""F64: the receiver of notifications is down; an alarm flaps.

What waits is bounded, an alarm has its hold-off, and in the end the receiver knows what holds, each change told once.
"""

from __future__ import annotations

import asyncio
import socket
from pathlib import Path

from gateway.core.conditions import ConditionState
from gateway.devices.schema import load_map
from gateway.faces.snmp.delivery import LAST_S, WINDOW
from gateway.faces.snmp.secret import Secret
from gateway.faces.snmp.settings import Receiver
from tests.core.test_conditions import BITS
from tests.faces.snmp.test_delivery import LAYOUT, Post, kinds, read
from tests.faces.snmp.test_traps import Gateway
from tests.machine import Stopwatch

DAY_S = 86400
EVERYTHING = {"array_faults": 0xFFF, "load_faults": 0xFF, "alarms": 0x1FFFFFFF}
CONDITION = (*LAYOUT.objects, 8, 1)


def told(pdu: bytes) -> list[tuple[int, int]]:
    """Code and state of the condition that a notification is about."""
    return [(oid[-1], int(value)) for oid, value in read(pdu)[1].items() if oid[:-2] == (*CONDITION, 6)]


def test_a_receiver_that_is_away_for_a_day_while_everything_flaps() -> None:
    post = Post(hold_s=30.0)
    sent = 0
    for second in range(0, DAY_S, 10):
        post.shows(**(EVERYTHING if second % 20 else {}))
        post.plant.wait(9)
        sent += len(post.send())
        assert post.stats.waiting <= len(BITS) + 6
        assert len(post.delivery._under_way) <= WINDOW
    assert sent <= DAY_S / LAST_S + 10
    assert post.silent()

    post.shows(array_faults=1 << 3)
    heard: list[tuple[int, int]] = []
    for _ in range(2000):
        for note in post.send():
            post.acknowledge(note)
            heard += told(note.pdu)
        post.plant.wait(1)
    assert post.stats.waiting == 0
    assert not post.silent()
    states: dict[int, list[int]] = {}
    for code, state in heard:
        states.setdefault(code, []).append(state)
    for _, _, condition in BITS:
        turns = states[condition.code]
        assert turns == [ConditionState.RAISED, ConditionState.CLEAR] * (len(turns) // 2) + [ConditionState.RAISED] * (
            len(turns) % 2
        )
        assert turns[-1] == post.plant.watch(condition.code).state
        assert len(turns) <= 3  # what was raised and cleared a thousand times meanwhile is told as it is


def test_a_flapping_alarm_is_told_once_a_hold_off_and_its_end_once() -> None:
    post = Post(inform=False, hold_s=30.0)
    post.send_all()
    heard: list[tuple[int, int]] = []
    for second in range(3600):
        post.shows(alarms=(second % 2) << 5)
        heard += [each for note in post.send_all() for each in told(note.pdu)]
    post.shows()
    for _ in range(3):
        post.plant.wait(60)
        heard += [each for note in post.send_all() for each in told(note.pdu)]
    post.plant.wait(3600)
    assert post.send_all() == []
    assert 100 <= len(heard) <= 3600 / 30 + 3
    assert heard == [(305, ConditionState.RAISED), (305, ConditionState.CLEAR)] * (len(heard) // 2)


def test_a_storm_is_told_at_the_rate_that_is_allowed() -> None:
    post = Post(inform=False, per_minute=10.0)
    sent = []
    for second in range(600):
        if second == 300:
            post.shows(**EVERYTHING)
        post.plant.wait(1)
        sent += post.send_all()
    assert 10 <= len(sent) <= 10 + 300 / 6 + 1
    assert set(kinds(sent[1:])) == {(*LAYOUT.notifications, 1)}


async def test_neither_the_loop_nor_another_receiver_waits_for_it(tmp_path: Path) -> None:
    """One receiver's port is closed, one is there and never answers, one gets its traps at once."""
    closed = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    closed.bind(("127.0.0.1", 0))
    port = closed.getsockname()[1]
    closed.close()
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as mute,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as good,
    ):
        for each in (mute, good):
            each.bind(("127.0.0.1", 0))
            each.setblocking(False)
        receivers = (
            Receiver("127.0.0.1", port, inform=True, community=Secret(b"c"), hold_s=0.0),
            Receiver("127.0.0.1", mute.getsockname()[1], inform=True, community=Secret(b"c"), hold_s=0.0),
            Receiver("127.0.0.1", good.getsockname()[1], inform=False, community=Secret(b"c"), hold_s=0.0),
        )
        gateway = Gateway(load_map("prostar-mppt"), receivers, tmp_path)
        worst = 0.0

        async def measure() -> None:
            nonlocal worst
            while True:
                watch = Stopwatch()
                await asyncio.sleep(0)
                worst = max(worst, watch.s)

        watching = asyncio.create_task(measure())
        async with gateway.running(), asyncio.timeout(30):
            loop = asyncio.get_running_loop()
            await loop.sock_recv(good, 2000)
            gateway.shows(**EVERYTHING)
            for _ in BITS:
                await loop.sock_recv(good, 2000)
        watching.cancel()
        await asyncio.wait([watching])
        assert gateway.agent.notifier.stats[1].acknowledged == 0
        assert gateway.agent.notifier.stats[1].waiting == len(BITS) + 1
        assert worst < 0.05
