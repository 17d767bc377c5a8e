"""F39: a read over two blocks of different times: one serial read; a pair never mixes two reads."""

from __future__ import annotations

from dataclasses import replace

import pytest

from gateway.core.snapshot import Block, DeviceState
from gateway.devices.model import Space
from tests.faces.modbus.conftest import Running, registers


@pytest.mark.parametrize("older_s", [0.0, 0.25])
async def test_a_read_over_two_blocks_is_one_serial_read(running: Running, older_s: float) -> None:
    world = running.world
    device = world.device(11)
    now = world.clock.now
    times = ((0, now - older_s), (16, now))
    blocks = tuple(Block(Space.REGISTERS, first, 16, registers(9, first, 16), read_at) for first, read_at in times)
    device.snapshot = replace(device.snapshot, state=DeviceState.ONLINE, blocks=blocks)
    client = await running.connect()
    pair = bytes.fromhex("03 000f 0002")
    assert await client.query(11, pair) == b"\x03\x04" + registers(1, 15, 2)
    assert world.line(11).transactions == [(1, pair)]
