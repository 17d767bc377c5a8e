"""Which controller a unit id stands for, by the way that the client came in."""

from __future__ import annotations

import asyncio

from gateway.faces.modbus.settings import LineListen

from .conftest import Client, Running, Serve, World, registers

READ = bytes.fromhex("03 0000 0001")
ANY = (("127.0.0.1", 0),)


async def connect(running: Running, listener: int) -> Client:
    bound = running.server.listeners[listener].bound
    assert bound is not None
    client = Client(*await asyncio.open_connection(*bound))
    running.clients.append(client)
    return client


def value(address: int) -> bytes:
    return b"\x03\x02" + registers(address, 0, 1)


async def test_a_port_that_stands_for_a_line_takes_the_addresses_there(serve: Serve, world: World) -> None:
    running = await serve(lines=(LineListen(ANY, "shelter-a"), LineListen(ANY, "shelter-b")))
    assert [listener.label for listener in running.server.listeners[1:]] == [
        "modbus 127.0.0.1:0 line shelter-a",
        "modbus 127.0.0.1:0 line shelter-b",
    ]
    for cached in (False, True, True):  # the second time a reply is made, the third time it is found ready
        if cached:
            for unit in (11, 12, 21):
                world.poll(unit)
        by_unit, first, second = [await connect(running, listener) for listener in range(3)]
        assert await by_unit.query(11, READ) == value(1)
        assert await first.query(1, READ) == value(1)
        assert await first.query(2, READ) == value(2)
        assert await second.query(1, READ) == value(1)
        assert await second.query(2, READ) == b"\x83\x0a", "the other line's address"
        assert await first.query(11, READ) == b"\x83\x0a", "a unit id is no address"
        assert await by_unit.query(1, READ) == b"\x83\x0a"
    assert world.lines[0].transactions == [(1, READ), (1, READ), (2, READ)]
    assert world.lines[1].transactions == [(1, READ)]


async def test_what_one_way_in_has_read_serves_the_other(serve: Serve, world: World) -> None:
    running = await serve(lines=(LineListen(ANY, "shelter-a"),))
    world.poll(11)
    settings = bytes.fromhex("03 e000 0010")
    by_unit, by_address = await connect(running, 0), await connect(running, 1)
    reply = await by_unit.query(11, settings)
    assert await by_address.query(1, settings) == reply
    assert len(world.lines[0].transactions) == 1


async def test_equal_bytes_mean_another_controller_on_another_port(serve: Serve, world: World) -> None:
    """Unit 12 of one port is array-12, of the other nobody's, also when its reply lies ready."""
    running = await serve(lines=(LineListen(ANY, "shelter-b"),))
    world.poll(12)
    by_unit, by_address = await connect(running, 0), await connect(running, 1)
    for _ in range(2):
        assert await by_unit.query(12, READ) == value(2)
        assert await by_address.query(12, READ) == b"\x83\x0a"


async def test_the_line_is_told_who_asks(running: Running, world: World) -> None:
    line = world.line(11)
    line.held = True
    clients = [await running.connect(local_addr=(host, 0)) for host in ("127.0.0.2", "127.0.0.3", "127.0.0.2")]
    for client in clients:
        client.ask(1, 11, READ)
    await running.until(lambda: bool(line.waiting) and len(line.waiting[0].waiters) == 3)
    assert sorted(ticket.client for ticket in line.waiting[0].waiters) == ["127.0.0.2", "127.0.0.2", "127.0.0.3"]
    line.release()
