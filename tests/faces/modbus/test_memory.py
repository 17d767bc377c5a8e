"""What is answered from memory, and what never is."""

from __future__ import annotations

from dataclasses import replace

import pytest

from gateway.core.snapshot import Block, DeviceState
from gateway.devices.model import Identification, Space

from .conftest import READ_80, Running, coils, registers


@pytest.mark.parametrize("function", [3, 4])
async def test_registers_come_from_the_snapshot(running: Running, function: int) -> None:
    running.world.poll(11)
    client = await running.connect()
    for first, count in ((0, 80), (0, 0x52), (0x51, 1), (17, 3)):
        for _ in range(2):  # made, then found ready
            reply = await client.query(11, bytes((function, 0, first, 0, count)))
            assert reply == bytes((function, 2 * count)) + registers(1, first, count)
    assert running.world.stats.cache_hits == 8
    assert not running.world.line(11).transactions


@pytest.mark.parametrize("function", [1, 2])
@pytest.mark.parametrize(("first", "count"), [(0, 256), (0, 1), (3, 13), (255, 1), (9, 8)])
async def test_coils_come_from_the_snapshot(running: Running, function: int, first: int, count: int) -> None:
    running.world.poll(11)
    client = await running.connect()
    reply = await client.query(11, bytes((function,)) + first.to_bytes(2) + count.to_bytes(2))
    expected = coils(1, first, count)
    assert reply == bytes((function, len(expected))) + expected
    assert not running.world.line(11).transactions


async def test_a_new_snapshot_replaces_a_ready_reply(running: Running) -> None:
    world = running.world
    world.poll(11)
    client = await running.connect()
    await client.query(11, READ_80)
    device = world.device(11)
    newer = Block(Space.REGISTERS, 0, 80, bytes(range(160)), world.clock.now)
    device.snapshot = replace(device.snapshot, blocks=(newer,))
    assert await client.query(11, READ_80) == b"\x03\xa0" + bytes(range(160))


@pytest.mark.parametrize("state", [DeviceState.STALE, DeviceState.UNKNOWN])
async def test_a_device_that_is_not_online_is_not_answered_from_memory(running: Running, state: DeviceState) -> None:
    world = running.world
    world.poll(11)
    client = await running.connect()
    await client.query(11, READ_80)
    world.set_state(11, state)
    await client.query(11, READ_80)
    assert world.line(11).transactions == [(1, READ_80)]


async def test_a_clients_read_serves_others_until_it_is_old(running: Running) -> None:
    world = running.world
    world.poll(11)
    client = await running.connect()
    settings = bytes.fromhex("03 e000 0010")
    part = bytes.fromhex("04 e004 0002")
    await client.query(11, settings)
    world.clock.now += 4.9
    world.poll(11)
    assert await client.query(11, part) == b"\x04\x04" + registers(1, 0xE004, 2)
    assert await client.query(11, settings) == b"\x03\x20" + registers(1, 0xE000, 16)
    assert len(world.line(11).transactions) == 1
    world.clock.now += 0.1
    await client.query(11, part)
    assert len(world.line(11).transactions) == 2


async def test_a_clients_read_is_as_old_as_its_question(running: Running) -> None:
    world = running.world
    world.poll(11)
    line = world.line(11)
    line.held = True
    client = await running.connect()
    settings = bytes.fromhex("03 e000 0010")
    client.ask(1, 11, settings)
    await running.until(lambda: len(line.waiting) == 1)
    world.clock.now += 5.0
    line.release()
    await client.adu()
    line.held = False
    await client.query(11, settings)
    assert len(line.transactions) == 2, "what was asked for five seconds ago may be five seconds old"


async def test_identification_comes_from_the_snapshot(running: Running) -> None:
    world = running.world
    world.poll(11)
    device = world.device(11)
    device.snapshot = replace(
        device.snapshot, identification=Identification("Morningstar Corp.", "PS-MPPT-40M", "v01.01.01")
    )
    client = await running.connect()
    whole = b"\x00\x11Morningstar Corp.\x01\x0bPS-MPPT-40M\x02\x09v01.01.01"
    assert await client.query(11, b"\x2b\x0e\x01\x00") == b"\x2b\x0e\x01\x81\x00\x00\x03" + whole
    assert await client.query(11, b"\x2b\x0e\x04\x01") == b"\x2b\x0e\x04\x81\x00\x00\x01\x01\x0bPS-MPPT-40M"
    assert await client.query(11, b"\x2b\x0e\x04\x03") == b"\xab\x02"
    assert not world.line(11).transactions


async def test_unknown_identification_is_asked_of_the_device(running: Running) -> None:
    running.world.poll(11)
    client = await running.connect()
    assert await client.query(11, b"\x2b\x0e\x01\x00") == b"\x2b\x0e\x01\x01\x00\x00\x01\x00\x04LINE"
    assert await client.query(11, b"\x2b\x0e\x04\x00") == b"\xab\x01", "the device has only stream access"
    assert len(running.world.line(11).transactions) == 2
