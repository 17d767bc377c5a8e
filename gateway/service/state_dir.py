"""Whose `state_dir` it is: a gateway that runs holds a lock on the folder itself.

Two gateways would give each other's SNMP engine the same boots and count writes twice, and a backup restored below one
that runs would be lost again. There is no lock file: a kill releases the lock and leaves nothing behind.
"""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path


@contextmanager
def claimed(state_dir: Path) -> Iterator[bool]:
    """Hold the folder of a gateway, made when it is missing; gives False only when somebody else holds it.

    A folder that cannot be made or locked (read-only, a file system without locks) stops nothing: live data go on.
    """
    with ExitStack() as stack:
        mine = True
        with suppress(OSError):
            state_dir.mkdir(mode=0o700, parents=True, exist_ok=True)
            mine = stack.enter_context(held(state_dir))
        yield mine


@contextmanager
def held(state_dir: Path) -> Iterator[bool]:
    """Hold the folder while the block runs; gives False when somebody else does. OSError when it is not there."""
    fd = os.open(state_dir, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            yield False
        else:
            yield True
    finally:
        os.close(fd)
