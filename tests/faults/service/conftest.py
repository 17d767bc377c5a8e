"""A gateway process a test; ended, with its lines, at the end of it."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable, Iterator
from pathlib import Path

import pytest

from tests.faults.service.rig import NotifySocket, Service


@pytest.fixture
async def service(
    tmp_path: Path, free_tcp_port: Callable[[], int], free_udp_port: Callable[[], int]
) -> AsyncIterator[Service]:
    """One line `shelter-a` with the controllers 1 and 2; nothing is started yet."""
    one = Service(tmp_path, (free_tcp_port(), free_udp_port(), free_tcp_port()))
    one.plug("shelter-a", 1, 2)
    yield one
    one.close()


@pytest.fixture
def systemd(tmp_path: Path) -> Iterator[NotifySocket]:
    """What stands for systemd."""
    one = NotifySocket(tmp_path / "notify")
    yield one
    one.close()
