"""Three clients that know nothing of this project see the same values and exceptions: mbpoll, pymodbus, Node's
modbus-serial.
"""

from __future__ import annotations

import asyncio
import json
import os
from collections.abc import Awaitable, Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import pytest
from pymodbus.client import AsyncModbusTcpClient

from gateway.core.snapshot import DeviceState
from gateway.errors import LineDown, QueueFull, ReplyCrcError, ReplyMismatch, ReplyTimeout, RequestError

from .conftest import ADDRESS, Running, World, coil, register

NODE = Path(__file__).parents[2] / "peers" / "node"


@dataclass(frozen=True)
class Step:
    """What a client is to ask."""

    unit: int
    function: int
    first: int
    count: int
    values: tuple[int, ...] = ()


@dataclass(frozen=True)
class Seen:
    """What a client says that it got: values of a read (none of a write), or the exception code."""

    values: tuple[int, ...] = ()
    exception: int | None = None


def good(unit: int, function: int, first: int, count: int) -> tuple[Step, Seen]:
    hold = coil if function in {1, 2} else register
    return Step(unit, function, first, count), Seen(
        tuple(int(hold(ADDRESS[unit], at)) for at in range(first, first + count))
    )


def bad(code: int, unit: int, function: int, first: int, count: int, *values: int) -> tuple[Step, Seen]:
    return Step(unit, function, first, count, values), Seen(exception=code)


READS = [
    good(unit, function, first, count)
    for unit in (11, 12, 21)  # 12 from memory, the others from their lines
    for function, first, count in ((1, 0, 1), (1, 3, 40), (2, 7, 9), (3, 0, 1), (3, 0, 82), (4, 2, 79), (3, 0x51, 1))
]
REFUSED = [
    *(bad(0x01, unit, 5, 2, 1, 1) for unit in (11, 12)),
    *(bad(0x01, unit, 6, 0xE000, 1, 7) for unit in (11, 12)),
    bad(0x01, 11, 15, 0, 3, 1, 0, 1),
    bad(0x01, 11, 16, 0xE000, 2, 1, 2),
    *(bad(0x02, 11, function, 0x0052, 1) for function in (3, 4)),
    bad(0x02, 12, 3, 0x0050, 3),
    bad(0x02, 11, 1, 0x0100, 1),
    bad(0x02, 12, 3, 0xFFFF, 2),
    *(bad(0x0A, 99, function, 0, 1) for function in (1, 2, 3, 4)),
    bad(0x0A, 250, 3, 0, 1),
    good(12, 3, 0, 82),  # and the next is right
]
FROM_THE_LINE: list[tuple[RequestError, int]] = [
    (ReplyCrcError(), 0x04),
    (ReplyMismatch(), 0x04),
    (QueueFull(), 0x06),
    (LineDown(), 0x0A),
    (ReplyTimeout(), 0x0B),
]

Client = Callable[[tuple[str, int], list[Step]], Awaitable[list[Seen]]]
FindPeer = Callable[[str], str]


async def output_of(*command: str, text: str = "") -> tuple[int, str]:
    process = await asyncio.create_subprocess_exec(
        *command,
        stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.STDOUT,
    )
    async with asyncio.timeout(30):
        out, _ = await process.communicate(text.encode())
    assert process.returncode is not None
    return process.returncode, out.decode()


async def by_pymodbus(address: tuple[str, int], steps: list[Step]) -> list[Seen]:
    client = AsyncModbusTcpClient(address[0], port=address[1], timeout=60, retries=0)
    assert await client.connect()
    seen = []
    for step in steps:
        unit = step.unit
        match step.function:
            case 1:
                reply = await client.read_coils(step.first, count=step.count, device_id=unit)
            case 2:
                reply = await client.read_discrete_inputs(step.first, count=step.count, device_id=unit)
            case 3:
                reply = await client.read_holding_registers(step.first, count=step.count, device_id=unit)
            case 4:
                reply = await client.read_input_registers(step.first, count=step.count, device_id=unit)
            case 5:
                reply = await client.write_coil(step.first, value=bool(step.values[0]), device_id=unit)
            case 6:
                reply = await client.write_register(step.first, step.values[0], device_id=unit)
            case 15:
                reply = await client.write_coils(step.first, [bool(value) for value in step.values], device_id=unit)
            case _:
                reply = await client.write_registers(step.first, list(step.values), device_id=unit)
        if reply.isError():
            seen.append(Seen(exception=reply.exception_code))
        else:
            values = reply.bits[: step.count] if step.function in {1, 2} else reply.registers
            seen.append(Seen(tuple(map(int, values))))
    client.close()
    return seen


MBPOLL_TYPES = {1: "0", 2: "1", 3: "4:hex", 4: "3:hex", 5: "0", 6: "4:hex", 15: "0", 16: "4:hex"}
LIBMODBUS_TEXTS = {
    "Illegal function": 0x01,
    "Illegal data address": 0x02,
    "Illegal data value": 0x03,
    "Slave device or server failure": 0x04,
    "Slave device or server is busy": 0x06,
    "Gateway path unavailable": 0x0A,
    "Target device failed to respond": 0x0B,
}


def by_mbpoll(program: str) -> Client:
    async def ask(address: tuple[str, int], steps: list[Step]) -> list[Seen]:
        seen = []
        for step in steps:
            # mbpoll takes its options in any order; values after the host are written.
            command = [program, "-m", "tcp", "-p", str(address[1]), "-a", str(step.unit), "-0", "-1", "-o", "10"]
            command += ["-t", MBPOLL_TYPES[step.function], "-r", str(step.first)]
            command += [address[0], *map(str, step.values)] if step.values else ["-c", str(step.count), address[0]]
            status, out = await output_of(*command)
            codes = [code for text, code in LIBMODBUS_TEXTS.items() if text in out]
            if codes:
                seen.append(Seen(exception=codes[0]))
                continue
            assert status == 0, out
            rows = [row.split(":")[1].split()[0] for row in out.splitlines() if row.startswith("[")]
            seen.append(Seen(tuple(int(row, 0) for row in rows)))
        return seen

    return ask


def by_modbus_serial(program: str) -> Client:
    async def ask(address: tuple[str, int], steps: list[Step]) -> list[Seen]:
        text = json.dumps([asdict(step) for step in steps])
        status, out = await output_of(program, str(NODE / "ask.js"), address[0], str(address[1]), text=text)
        assert status == 0, out
        return [
            Seen(exception=result["exception"]) if isinstance(result, dict) else Seen(tuple(result))
            for result in json.loads(out)
        ]

    return ask


@pytest.fixture(params=["pymodbus", "mbpoll", "modbus-serial"])
def client(request: pytest.FixtureRequest, peer: FindPeer) -> Client:
    match request.param:
        case "pymodbus":
            return by_pymodbus
        case "mbpoll":
            return by_mbpoll(peer("mbpoll"))
        case _:
            program = peer("node")
            if not (NODE / "node_modules").is_dir():
                reason = "modbus-serial is not installed; tests/peers/install.sh installs it"
                if os.environ.get("CI"):
                    pytest.fail(reason)
                pytest.skip(reason)
            return by_modbus_serial(program)


async def check(running: Running, client: Client, cases: list[tuple[Step, Seen]]) -> None:
    seen = await client(running.address, [step for step, _ in cases])
    for (step, expected), found in zip(cases, seen, strict=True):
        assert found == expected, step


@pytest.mark.peer
async def test_every_table_from_memory_and_from_the_line(running: Running, world: World, client: Client) -> None:
    world.poll(12)
    await check(running, client, READS)


@pytest.mark.peer
async def test_what_the_gateway_refuses(running: Running, world: World, client: Client) -> None:
    world.poll(12)
    await check(running, client, REFUSED)
    assert not any(pdu[0] in {5, 6, 15, 16} for line in world.lines for _, pdu in line.transactions)


@pytest.mark.peer
async def test_what_the_line_says(running: Running, world: World, client: Client) -> None:
    world.poll(12)
    for error, code in FROM_THE_LINE:
        world.line(11).outcomes[1] = error
        await check(running, client, [bad(code, 11, 3, 0, 2), good(12, 3, 0, 2)])
    world.set_state(21, DeviceState.OFFLINE)
    await check(running, client, [bad(0x0B, 21, 4, 0, 1), good(12, 4, 0, 1)])
