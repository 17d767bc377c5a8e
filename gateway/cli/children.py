"""Child processes that never outlive their parent.

Each child leads its own process group, so that Ctrl-C reaches only the parent, which then ends the children in order.
When the parent is killed, the kernel ends them (PR_SET_PDEATHSIG).
"""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import IO

PR_SET_PDEATHSIG = 1
STOP_S = 1.5


def start_gateway_command(arguments: Sequence[str], log: IO[bytes]) -> subprocess.Popen[bytes]:
    """Start `prostar-gateway ARGUMENTS`; what it says goes to `log`."""
    libc = ctypes.CDLL(None)  # loaded here: nothing may be loaded between fork and exec
    parent = os.getpid()

    def end_with_parent() -> None:
        libc.prctl(PR_SET_PDEATHSIG, signal.SIGTERM)
        if os.getppid() != parent:
            os._exit(0)

    return subprocess.Popen(  # noqa: S603 - our own interpreter and module
        [sys.executable, "-m", "gateway", *arguments],
        stdin=subprocess.DEVNULL,
        stdout=log,
        stderr=log,
        start_new_session=True,
        preexec_fn=end_with_parent,  # noqa: PLW1509 - no threads are running yet, and only two system calls are made
    )


def stop_all(children: Sequence[subprocess.Popen[bytes]]) -> None:
    """End every child: SIGTERM to all, SIGKILL to what still lives 1.5 s after that."""
    for child in children:
        if child.poll() is None:
            child.terminate()
    until = time.monotonic() + STOP_S
    for child in children:
        try:
            child.wait(timeout=max(0.0, until - time.monotonic()))
        except subprocess.TimeoutExpired:
            child.kill()
    for child in children:
        child.wait()


def last_lines(log: Path, count: int = 8) -> list[str]:
    """The end of a child's log."""
    return log.read_text(errors="replace").splitlines()[-count:]
