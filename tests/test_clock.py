"""The machine's clocks, on a machine that slept."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable

import pytest

from gateway.clock import SystemClock

SLEPT_S = 86_400
LOOK = "import time; from gateway.clock import SystemClock; print(SystemClock().monotonic() - time.monotonic())"


@pytest.mark.peer
def test_time_goes_on_while_the_machine_sleeps(peer: Callable[[str], str]) -> None:
    """In a namespace of its own, whose clocks say that it slept for a day."""
    slept = ["--user", "--map-root-user", "--time", "--fork", f"--boottime={SLEPT_S}"]
    command = [peer("unshare"), *slept, sys.executable, "-c", LOOK]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    if done.returncode:
        pytest.skip(f"no namespaces here: {done.stderr.strip()}")
    apart_s = time.clock_gettime(time.CLOCK_BOOTTIME) - time.monotonic()
    assert float(done.stdout) - apart_s == pytest.approx(SLEPT_S, abs=1.0)


def test_it_never_goes_back() -> None:
    clock = SystemClock()
    looks = [clock.monotonic() for _ in range(1000)]
    assert looks == sorted(looks)
