"""F37: many clients ask the same block: one serial read answers all; those that leave do not cancel it."""

from __future__ import annotations

import pytest

from gateway.faces.modbus.settings import ModbusSettings
from gateway.modbus import mbap
from gateway.modbus.pdu import ReadRequest
from tests.core.test_engine import Registers
from tests.core.virtual_line import make_line
from tests.faults.tcp.virtual import VirtualFace

CLIENTS = 8
ASKED = ReadRequest(3, 0x8000, 10).encode()  # of no poll's block


@pytest.mark.parametrize(
    "leave",
    [
        pytest.param((), id="nobody leaves"),
        pytest.param((3,), id="one in the middle"),
        pytest.param((0,), id="who asked first"),
        pytest.param((0, 1, 2, 4, 5, 6, 7), id="all but one"),
    ],
)
@pytest.mark.parametrize("on_the_wire", [False, True], ids=["while it waits", "while it is on the wire"])
async def test_many_clients_ask_the_same_and_the_line_once(leave: tuple[int, ...], on_the_wire: bool) -> None:
    line = make_line(Registers(1))
    face = VirtualFace(line, ModbusSettings())
    line.run(5.0)
    line.sent.clear()

    def made() -> int:
        return sum(frame[1:-2] == ASKED for _, frame in line.sent)

    clients = [face.connect(f"192.0.2.{number}") for number in range(CLIENTS)]
    for tid, (connection, _) in enumerate(clients):
        connection.data_received(mbap.encode(tid, 11, ASKED))
    while on_the_wire and not made():
        line.run(0.001)
    for at in leave:
        clients[at][0].connection_lost(None)
    line.run(2.0)
    reply = b"\x03\x14" + b"".join(at.to_bytes(2) for at in range(0x8000, 0x800A))
    for tid, (_, transport) in enumerate(clients):
        got = [adu for _, adu in transport.replies.values()]
        assert got == ([] if tid in leave else [mbap.Adu(tid, 11, reply)])
    assert made() == 1
    assert face.stats.forwarded == CLIENTS


async def test_when_nobody_waits_any_more_nothing_is_sent() -> None:
    line = make_line(Registers(1))
    face = VirtualFace(line, ModbusSettings())
    line.run(5.0)
    line.sent.clear()
    clients = [face.connect(f"192.0.2.{number}") for number in range(CLIENTS)]
    for connection, _ in clients:
        connection.data_received(mbap.encode(1, 11, ASKED))
    for connection, _ in clients:
        connection.connection_lost(None)
    line.run(2.0)
    assert ASKED not in {frame[1:-2] for _, frame in line.sent}
