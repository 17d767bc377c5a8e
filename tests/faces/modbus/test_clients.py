"""Clients that know nothing of this project."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from dataclasses import replace

import pytest
from pymodbus.client import AsyncModbusTcpClient
from pymodbus.pdu.mei_message import ReadDeviceInformationResponse

from gateway.core.snapshot import DeviceState
from gateway.devices.model import Identification

from .conftest import Running, coil, register


@pytest.fixture
async def pymodbus_client(running: Running) -> AsyncIterator[AsyncModbusTcpClient]:
    host, port = running.address
    client = AsyncModbusTcpClient(host, port=port, timeout=60, retries=0)
    assert await client.connect()
    yield client
    client.close()


async def test_pymodbus_reads_every_table(running: Running, pymodbus_client: AsyncModbusTcpClient) -> None:
    client = pymodbus_client
    running.world.poll(12)  # 12 from memory, 11 and 21 from their lines
    for unit, address in ((11, 1), (12, 2), (21, 1)):
        values = [register(address, at) for at in range(3, 83 - 3)]
        assert (await client.read_holding_registers(3, count=77, device_id=unit)).registers == values
        assert (await client.read_input_registers(3, count=77, device_id=unit)).registers == values
        bits = [coil(address, at) for at in range(5, 25)]
        assert (await client.read_coils(5, count=20, device_id=unit)).bits[:20] == bits
        assert (await client.read_discrete_inputs(5, count=20, device_id=unit)).bits[:20] == bits


async def test_pymodbus_asks_many_at_once(running: Running, pymodbus_client: AsyncModbusTcpClient) -> None:
    running.world.poll(12)
    asked = [((11, 12, 21)[at % 3], at % 60) for at in range(60)]
    replies = await asyncio.gather(
        *(pymodbus_client.read_holding_registers(first, count=2, device_id=unit) for unit, first in asked)
    )
    for (unit, first), reply in zip(asked, replies, strict=True):
        assert reply.registers == [register(2 if unit == 12 else 1, at) for at in (first, first + 1)]


@pytest.mark.parametrize(
    ("unit", "span", "code"),
    [(11, (0xFFFF, 2), 2), (99, (0, 1), 0x0A), (12, (0x0100, 1), 2), (21, (0, 1), 0x0B)],
)
async def test_pymodbus_sees_the_exception_codes(
    running: Running, pymodbus_client: AsyncModbusTcpClient, unit: int, span: tuple[int, int], code: int
) -> None:
    running.world.set_state(21, DeviceState.OFFLINE)
    first, count = span
    reply = await pymodbus_client.read_holding_registers(first, count=count, device_id=unit)
    assert reply.isError()
    assert reply.exception_code == code


async def test_pymodbus_cannot_write(running: Running, pymodbus_client: AsyncModbusTcpClient) -> None:
    client = pymodbus_client
    for reply in (
        await client.write_register(0xE000, 1, device_id=11),
        await client.write_registers(0xE000, [1, 2], device_id=11),
        await client.write_coil(1, value=True, device_id=11),
        await client.write_coils(1, [True], device_id=11),
        await client.mask_write_register(address=0xE000, device_id=11),
        await client.readwrite_registers(read_count=1, write_address=0xE000, values=[1], device_id=11),
    ):
        assert reply.exception_code == 1
    assert not running.world.line(11).transactions


async def test_pymodbus_reads_the_identification(running: Running, pymodbus_client: AsyncModbusTcpClient) -> None:
    running.world.poll(11)
    device = running.world.device(11)
    texts = (b"Morningstar Corp.", b"PS-MPPT-40M", b"v01.01.01")
    device.snapshot = replace(device.snapshot, identification=Identification(*(text.decode() for text in texts)))
    reply = await pymodbus_client.read_device_information(read_code=1, object_id=0, device_id=11)
    assert isinstance(reply, ReadDeviceInformationResponse)
    assert reply.information == dict(enumerate(texts))
    reply = await pymodbus_client.read_device_information(read_code=4, object_id=2, device_id=11)
    assert isinstance(reply, ReadDeviceInformationResponse)
    assert reply.information == {2: texts[2]}


@pytest.mark.peer
@pytest.mark.parametrize("unit", [11, 12, 21])
async def test_mbpoll_reads_registers(running: Running, peer: Callable[[str], str], unit: int) -> None:
    running.world.poll(12)
    host, port = running.address
    process = await asyncio.create_subprocess_exec(
        *(peer("mbpoll"), "-m", "tcp", "-p", str(port), "-a", str(unit), "-0", "-t", "4:hex"),
        *("-r", "0", "-c", "82", "-1", host),
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
    )
    async with asyncio.timeout(30):
        out, err = await process.communicate()
    assert process.returncode == 0, err
    address = 2 if unit == 12 else 1
    for at in range(82):
        assert f"[{at}]: \t0x{register(address, at):04X}".encode() in out
