"""F39: a read over two blocks of different times: one serial read; a pair never mixes two reads."""

from __future__ import annotations

from dataclasses import replace

from gateway.core.snapshot import Block, DeviceState
from gateway.devices.model import Space
from tests.faces.modbus.conftest import Running, registers


async def test_a_read_over_two_blocks_is_one_serial_read(running: Running) -> None:
    world = running.world
    device = world.device(11)
    now = world.clock.now
    blocks = tuple(Block(Space.REGISTERS, at, 16, registers(9, at, 16), now) for at in (0, 16))
    device.snapshot = replace(device.snapshot, state=DeviceState.ONLINE, blocks=blocks)
    client = await running.connect()
    pair = bytes.fromhex("03 000f 0002")
    assert await client.query(11, pair) == b"\x03\x04" + registers(1, 15, 2)
    assert world.line(11).transactions == [(1, pair)]
