"""Unit 255 over TCP: the gateway's own registers, for clients that know nothing of this project; off by default."""

from __future__ import annotations

from dataclasses import replace

import pytest

from gateway.core.snapshot import DeviceState
from gateway.core.status_registers import COLUMNS
from gateway.faces.modbus.settings import LineListen

from .conftest import Serve, World
from .test_matrix import Client, Seen, Step, client

__all__ = ["client"]

AT = {column.name: column.first for column in COLUMNS}
STATE_OF_11 = bytes((3, *(AT["device_state"] + 11).to_bytes(2), 0, 1))


@pytest.mark.peer
async def test_foreign_clients_read_states_and_ages(serve: Serve, world: World, client: Client) -> None:
    running = await serve(status_unit=True)
    world.poll(11, age_s=2.5)
    world.poll(12)
    world.set_state(12, DeviceState.STALE)
    asked = [
        Step(255, 3, 0, 6),
        Step(255, 4, AT["device_state"] + 11, 11),
        Step(255, 3, AT["device_age"] + 11, 1),
        Step(255, 3, AT["line_state"], 4),
        Step(255, 3, 0x0F, 1),  # behind the gateway's registers
        Step(255, 3, 0x0E, 2),  # partly
        Step(255, 1, 0, 1),
        Step(255, 6, 0, 0, (7,)),
    ]
    assert await client(running.address, asked) == [
        Seen((1, 2, 3, 1, 0, 2)),
        Seen((2, 3, *([0] * 8), 1)),
        Seen((25,)),
        Seen((0, 2, 2, 0)),
        Seen(exception=2),
        Seen(exception=2),
        Seen(exception=1),
        Seen(exception=1),
    ]
    assert not world.lines[0].transactions, "no line is asked"


async def test_it_answers_while_lines_hang_and_is_never_remembered(serve: Serve, world: World) -> None:
    running = await serve(status_unit=True)
    for line in world.lines:
        line.held = True
    waiting, own = await running.connect(), await running.connect()
    waiting.ask(1, 11, bytes.fromhex("03 0000 0001"))
    await running.until(lambda: bool(world.line(11).waiting))
    for state, shown in ((DeviceState.ONLINE, 2), (DeviceState.OFFLINE, 4), (DeviceState.STALE, 3)):
        device = world.device(11)
        device.snapshot = replace(device.snapshot, state=state)
        assert await own.query(255, STATE_OF_11) == bytes((3, 2, 0, shown))
    world.line(11).release()
    await waiting.adu()


async def test_it_says_who_it_is(serve: Serve) -> None:
    client = await (await serve(status_unit=True)).connect()
    assert b"prostar-gateway" in await client.query(255, bytes.fromhex("2b 0e 01 00"))


async def test_off_by_default_and_not_on_the_port_of_a_line(serve: Serve) -> None:
    off = await (await serve()).connect()
    assert await off.query(255, STATE_OF_11) == b"\x83\x0a"
    running = await serve(status_unit=True, lines=(LineListen((("127.0.0.1", 0),), "shelter-a"),))
    by_address = await running.connect(listener=1)
    assert await by_address.query(255, STATE_OF_11) == b"\x83\x0a"


async def test_a_refused_write_is_counted_and_told(
    serve: Serve, world: World, caplog: pytest.LogCaptureFixture
) -> None:
    client = await (await serve(status_unit=True)).connect()
    assert await client.query(255, bytes.fromhex("06 0000 0007")) == b"\x86\x01"
    assert world.stats.refused == {"writes_disabled": 1}
    assert "event=write_refused peer=127.0.0.1 unit=255 function=0x06" in caplog.text
