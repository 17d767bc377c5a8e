"""The worked examples and state diagrams of the Modbus Application Protocol V1.1b3, through the TCP face.

Each example is asked of a device that holds what the example says, once from memory and once from the line.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import pytest

from gateway.core.snapshot import Block, DeviceState
from gateway.devices.model import Identification, Space
from gateway.errors import ReplyCrcError
from gateway.modbus import mbap
from tests.faces.modbus.conftest import Running, World


@dataclass(frozen=True)
class Example:
    """Request and reply as printed; what is held from `first` on so that it is right."""

    clause: str
    request: str
    reply: str
    space: Space
    first: int
    held: str


COILS, REGISTERS = Space.COILS, Space.REGISTERS
EXAMPLES = [
    Example("6.1 coils 20 to 38", "01 00 13 00 13", "01 03 CD 6B 05", COILS, 0x13, "CD 6B 05"),
    Example("6.2 inputs 197 to 218", "02 00 C4 00 16", "02 03 AC DB 35", COILS, 0xC4, "AC DB 35"),
    Example("6.3 registers 108 to 110", "03 00 6B 00 03", "03 06 02 2B 00 00 00 64", REGISTERS, 0x6B, "022B 0000 0064"),
    Example("6.4 input register 9", "04 00 08 00 01", "04 02 00 0A", REGISTERS, 8, "000A"),
]


@pytest.mark.parametrize("from_memory", [True, False], ids=["memory", "line"])
@pytest.mark.parametrize("example", EXAMPLES, ids=lambda example: example.clause)
async def test_worked_example(running: Running, world: World, example: Example, from_memory: bool) -> None:
    request, reply = bytes.fromhex(example.request), bytes.fromhex(example.reply)
    if from_memory:
        data = bytes.fromhex(example.held)
        count = len(data) // 2 if example.space is REGISTERS else int.from_bytes(request[3:5])
        block = Block(example.space, example.first, count, data, world.clock.now)
        device = world.device(12)
        device.snapshot = replace(device.snapshot, state=DeviceState.ONLINE, blocks=(block,))
    else:
        world.line(12).outcomes[2] = reply
    client = await running.connect()
    assert await client.query(12, request) == reply
    assert bool(world.line(12).transactions) is not from_memory


READS = {1: 2000, 2: 2000, 3: 125, 4: 125}


@pytest.mark.parametrize("function", READS)
async def test_state_diagram_of_a_read(running: Running, world: World, function: int) -> None:
    """Figures 11 to 14: function, then quantity, then address, then the device; each with its own exception."""
    most = READS[function]
    client = await running.connect()

    async def asked(first: int, count: int) -> bytes:
        return await client.query(11, bytes((function,)) + first.to_bytes(2) + count.to_bytes(2))

    def refused(code: int) -> bytes:
        return bytes((function | 0x80, code))

    for count in (0, most + 1, 0xFFFF):
        assert await asked(0, count) == refused(3)
        assert await asked(0xFFFF, count) == refused(3), "quantity comes before address"
    assert await asked(0xFFFF, 2) == refused(2)
    assert await asked(0x10000 - most + 1, most) == refused(2)
    assert not world.line(11).transactions
    await asked(0xFFFF, 1)
    await asked(0x10000 - most, most)
    assert len(world.line(11).transactions) == 2, "these end at the last address there is: the device decides"
    world.line(11).outcomes[1] = ReplyCrcError()
    assert await asked(0, 1) == refused(4)
    world.line(11).outcomes[1] = refused(4)
    assert await asked(0, 1) == refused(4)
    del world.line(11).outcomes[1]
    reply = await asked(0, 1)
    assert reply[:2] == bytes((function, 1 if function < 3 else 2))


@pytest.mark.parametrize(
    "request_pdu",
    [
        "05 00AC FF00",
        "06 0001 0003",
        "0F 0013 000A 02 CD01",
        "10 0001 0002 04 000A 0102",
        "16 0004 00F2 0025",
        "17 0003 0006 000E 0003 06 00FF 00FF 00FF",
        "07",
        "08 0000 A537",
        "0B",
        "0C",
        "11",
        "14 07 06 0004 0001 0002",
        "15 09 06 0004 0007 0001 06AF",
        "18 04DE",
        "2B 0D 00 00",
    ],
    ids=lambda text: f"function-{text[:2]}",
)
async def test_what_the_server_does_not_do_is_01(running: Running, world: World, request_pdu: str) -> None:
    """The documents' own examples of functions that change a device (writing is off), or that it does not have."""
    pdu = bytes.fromhex(request_pdu)
    client = await running.connect()
    assert await client.query(11, pdu) == bytes((pdu[0] | 0x80, 1))
    assert not world.line(11).transactions


TEXTS = (b"Morningstar Corp.", b"PS-MPPT-40M", b"v01.01.01")


def objects(*numbers: int) -> bytes:
    return b"".join(bytes((number, len(TEXTS[number]))) + TEXTS[number] for number in numbers)


@pytest.fixture
def known(world: World) -> World:
    device = world.device(12)
    identification = Identification(*(text.decode() for text in TEXTS))
    device.snapshot = replace(device.snapshot, state=DeviceState.ONLINE, identification=identification)
    return world


@pytest.mark.parametrize(
    ("asked", "reply"),
    [
        ("0E 01 00", b"\x0e\x01\x81\x00\x00\x03" + objects(0, 1, 2)),  # basic, stream
        ("0E 01 01", b"\x0e\x01\x81\x00\x00\x02" + objects(1, 2)),
        ("0E 01 02", b"\x0e\x01\x81\x00\x00\x01" + objects(2)),
        ("0E 01 03", b"\x0e\x01\x81\x00\x00\x03" + objects(0, 1, 2)),  # unknown object: from the beginning
        ("0E 01 FF", b"\x0e\x01\x81\x00\x00\x03" + objects(0, 1, 2)),
        ("0E 02 00", b"\x0e\x02\x81\x00\x00\x03" + objects(0, 1, 2)),  # more than there is: what there is
        ("0E 03 00", b"\x0e\x03\x81\x00\x00\x03" + objects(0, 1, 2)),
        ("0E 04 00", b"\x0e\x04\x81\x00\x00\x01" + objects(0)),  # individual
        ("0E 04 01", b"\x0e\x04\x81\x00\x00\x01" + objects(1)),
        ("0E 04 02", b"\x0e\x04\x81\x00\x00\x01" + objects(2)),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
async def test_device_identification(running: Running, known: World, asked: str, reply: bytes) -> None:
    """6.21: from what was read of the device, by stream and by object, without asking it again."""
    client = await running.connect()
    assert await client.query(12, b"\x2b" + bytes.fromhex(asked)) == b"\x2b" + reply
    assert not known.line(12).transactions


@pytest.mark.parametrize(
    ("asked", "code"),
    [("0E 04 03", 2), ("0E 04 80", 2), ("0E 00 00", 3), ("0E 05 00", 3), ("0E 01", 3), ("0D 01 00", 1)],
)
async def test_device_identification_refused(running: Running, known: World, asked: str, code: int) -> None:
    """Figure 27: MEI type, then object id, then read code."""
    client = await running.connect()
    assert await client.query(12, b"\x2b" + bytes.fromhex(asked)) == bytes((0xAB, code))


async def test_adu_of_the_messaging_guide(running: Running, world: World) -> None:
    """Messaging on TCP/IP V1.0b, 3.1.3: transaction 0x1501 reads one register, and all of the header comes back."""
    world.line(12).outcomes[2] = b"\x03\x02\x00\x05"
    client = await running.connect()
    client.send(bytes.fromhex("15 01 00 00 00 06 0C 03 00 04 00 01"))
    assert mbap.encode(*await client.adu()) == bytes.fromhex("15 01 00 00 00 05 0C 03 02 00 05")
