"""What systemd is told, on a socket that stands for its own."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from gateway.service.systemd import Systemd

Receive = Callable[[], str]


@pytest.fixture(params=["path", "abstract"])
def listening(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[str, socket.socket]]:
    name = str(tmp_path / "notify") if request.param == "path" else f"@prostar-test-{os.getpid()}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as receiver:
        receiver.bind(name.replace("@", "\0", 1) if name.startswith("@") else name)
        receiver.settimeout(5)
        yield name, receiver


def test_every_message_arrives_in_the_words_of_sd_notify(listening: tuple[str, socket.socket]) -> None:
    name, receiver = listening
    systemd = Systemd({"NOTIFY_SOCKET": name})
    systemd.ready("serving")
    systemd.reloading(12.5)
    systemd.alive("serving still")
    systemd.stopping()
    told = [receiver.recv(4096).decode() for _ in range(4)]
    assert told == [
        "READY=1\nSTATUS=serving",
        "RELOADING=1\nMONOTONIC_USEC=12500000",
        "WATCHDOG=1\nSTATUS=serving still",
        "STOPPING=1",
    ]


def test_without_systemd_nothing_is_sent_and_nothing_watched() -> None:
    systemd = Systemd({"WATCHDOG_USEC": "1000000"})
    systemd.ready("serving")
    assert systemd.watchdog_s is None


def test_a_manager_that_is_gone_or_reads_nothing_disturbs_nobody(tmp_path: Path) -> None:
    Systemd({"NOTIFY_SOCKET": str(tmp_path / "gone")}).alive("")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as receiver:
        receiver.bind(str(tmp_path / "slow"))
        systemd = Systemd({"NOTIFY_SOCKET": str(tmp_path / "slow")})
        for _ in range(5000):
            systemd.alive("")


@pytest.mark.parametrize(
    ("variables", "watchdog_s"),
    [
        ({"WATCHDOG_USEC": "20000000"}, 20.0),
        ({"WATCHDOG_USEC": "20000000", "WATCHDOG_PID": "this process"}, 20.0),
        ({"WATCHDOG_USEC": "20000000", "WATCHDOG_PID": "1"}, None),
        ({"WATCHDOG_USEC": "0"}, None),
        ({"WATCHDOG_USEC": "soon"}, None),
        ({"WATCHDOG_USEC": "²"}, None),
        ({}, None),
    ],
)
def test_the_watchdog_is_fed_only_if_it_is_ours(variables: dict[str, str], watchdog_s: float | None) -> None:
    variables = {key: str(os.getpid()) if value == "this process" else value for key, value in variables.items()}
    assert Systemd({"NOTIFY_SOCKET": "/run/notify", **variables}).watchdog_s == watchdog_s
