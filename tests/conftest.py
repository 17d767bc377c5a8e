"""What every test room may use: foreign programs, free ports, hypothesis profiles.

Room-specific helpers live in the conftest.py of the room.
"""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
from collections.abc import Callable, Iterator

import pytest
from hypothesis import HealthCheck, settings

from tests.cable import Cable
from tests.machine import Bystander
from tests.ports import free_port

# Deadlines measure the machine, not the code. CI replays the same examples on every run, so that a red
# build means a changed product; a developer's run explores new ones.
settings.register_profile("dev", deadline=None)
settings.register_profile("ci", deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("ci" if os.environ.get("CI") else "dev")

SBIN = ("/usr/local/sbin", "/usr/sbin", "/sbin")
"""Where Debian puts daemons; not in an ordinary user's PATH."""


@pytest.fixture(scope="session")
def peer() -> Callable[[str], str]:
    """`peer("mbpoll")` is the path of a foreign program; skips when it is absent, fails when CI is set."""
    search = os.pathsep.join([os.environ.get("PATH", os.defpath), *SBIN])

    def find(name: str) -> str:
        path = shutil.which(name, path=search)
        if path is not None:
            return path
        reason = f"{name} is not installed; tests/peers/install.sh installs every peer"
        if os.environ.get("CI"):
            pytest.fail(f"{reason} (a missing peer is a failure because CI is set)")
        pytest.skip(reason)

    return find


@pytest.fixture(autouse=True)
def signals_stay_as_they_were() -> Iterator[None]:
    """No test leaves a signal blocked: the processes of the next one would not hear it."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, ())
    yield
    assert signal.pthread_sigmask(signal.SIG_SETMASK, before) == before


@pytest.fixture
def cable(peer: Callable[[str], str]) -> Iterator[Cable]:
    """A cable to another machine; skipped where network namespaces are not permitted."""
    made = Cable(peer("ip"))
    try:
        made.plug_in()
    except subprocess.CalledProcessError as error:
        made.remove()
        pytest.skip(f"network namespaces are not permitted here: {error.stderr.strip()}")
    yield made
    made.remove()


@pytest.fixture
def passing() -> Iterator[Bystander]:
    """What tells how long other processes take, once it is started."""
    bystander = Bystander()
    yield bystander
    bystander.stop()


@pytest.fixture
def free_tcp_port() -> Callable[[], int]:
    """A TCP port of 127.0.0.1 that was free a moment ago, for programs that cannot be given port 0."""
    return lambda: free_port(socket.SOCK_STREAM)


@pytest.fixture
def free_udp_port() -> Callable[[], int]:
    """A UDP port of 127.0.0.1 that was free a moment ago, for programs that cannot be given port 0."""
    return lambda: free_port(socket.SOCK_DGRAM)
