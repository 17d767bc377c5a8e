"""Child processes end within their time, however many of them do not want to."""

from __future__ import annotations

import subprocess
import sys
import time

from gateway.cli.children import STOP_S, stop_all

STUBBORN = """
import signal, sys
signal.signal(signal.SIGTERM, signal.SIG_IGN)
print("up", flush=True)
sys.stdin.read()
"""


def stubborn() -> subprocess.Popen[bytes]:
    child = subprocess.Popen([sys.executable, "-c", STUBBORN], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert child.stdout is not None
    assert child.stdout.readline() == b"up\n"
    return child


def test_all_children_together_have_the_time_of_one() -> None:
    children = [stubborn() for _ in range(3)]
    began = time.monotonic()
    stop_all(children)
    took_s = time.monotonic() - began
    assert [child.poll() for child in children] == [-9, -9, -9]
    assert took_s < 2 * STOP_S
    for child in children:
        for pipe in (child.stdin, child.stdout):
            assert pipe is not None
            pipe.close()
