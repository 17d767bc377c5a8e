"""The watchdog is fed as long as everything works, and not by a loop alone."""

from __future__ import annotations

import asyncio
import logging
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from gateway.service.systemd import Systemd
from gateway.service.watchdog import LATE_S, Watchdog

PERIOD_S = 20.0


class Looks:
    """What is found at each look, and how often systemd was told until then."""

    def __init__(self, found: list[tuple[str, ...]], receiver: socket.socket) -> None:
        self.found = found
        self.receiver = receiver
        self.fed: list[bool] = []
        self.pauses: set[float] = set()

    def stuck(self, most_s: float) -> tuple[str, ...]:
        assert most_s == LATE_S
        if not self.found:
            raise asyncio.CancelledError
        return self.found.pop(0)

    async def sleep(self, seconds: float) -> None:
        self.pauses.add(seconds)
        try:
            self.fed.append(self.receiver.recv(100) == b"WATCHDOG=1\nSTATUS=1 of 1 controllers online")
        except BlockingIOError:
            self.fed.append(False)


@pytest.fixture
def receiver(tmp_path: Path) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as one:
        one.bind(str(tmp_path / "notify"))
        one.setblocking(False)
        yield one


async def look(receiver: socket.socket, tmp_path: Path, *found: tuple[str, ...]) -> Looks:
    looks = Looks(list(found), receiver)
    systemd = Systemd({"NOTIFY_SOCKET": str(tmp_path / "notify")})
    with pytest.raises(asyncio.CancelledError):
        await Watchdog(systemd, PERIOD_S, looks.stuck, lambda: "1 of 1 controllers online", sleep=looks.sleep).run()
    return looks


async def test_it_is_fed_four_times_a_period(receiver: socket.socket, tmp_path: Path) -> None:
    looks = await look(receiver, tmp_path, (), (), ())
    assert looks.fed == [True, True, True]
    assert looks.pauses == {PERIOD_S / 4}


async def test_what_is_over_at_the_next_look_does_not_count(receiver: socket.socket, tmp_path: Path) -> None:
    assert (await look(receiver, tmp_path, ("line a",), ("line b",), ())).fed == [True, True, True]


async def test_what_stays_stuck_starves_it_and_is_said_once(
    receiver: socket.socket, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    looks = await look(receiver, tmp_path, ("line a",), ("line a",), ("line a",), (), ("line a",), ("line a",))
    assert looks.fed == [True, False, False, True, True, False]
    said = [record.getMessage() for record in caplog.records if record.levelno == logging.CRITICAL]
    assert said == ['event=watchdog_not_fed stuck="line a"'] * 2
