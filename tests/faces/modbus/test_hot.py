"""The memory of ready replies."""

from __future__ import annotations

from gateway.core.serving import FromMemory
from gateway.core.snapshot import Snapshot
from gateway.faces.modbus.hot import HotReplies

from .conftest import World


def test_it_never_holds_more_than_its_capacity(world: World) -> None:
    hot = HotReplies(capacity=10)
    device = world.device(11)
    for number in range(1000):
        request = number.to_bytes(2)
        hot.keep(request, device, FromMemory(b"", Snapshot().mark, 5.0), request * 2)
        assert 0 < len(hot) <= 10
        entry = hot.find(request)
        assert entry is not None
        assert entry[0] == 5.0
        assert entry[1] is device
        assert entry[3] == request * 2


def test_a_full_memory_takes_a_newer_reply_without_losing_the_others(world: World) -> None:
    hot = HotReplies(capacity=3)
    device = world.device(11)
    for valid_until in (5.0, 6.0):
        for number in range(3):
            hot.keep(bytes((number,)), device, FromMemory(b"", Snapshot().mark, valid_until), b"")
    assert len(hot) == 3
    entry = hot.find(b"\0")
    assert entry is not None
    assert entry[0] == 6.0
