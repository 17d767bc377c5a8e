"""Every request is answered, or its connection closed, within the deadline that `check-config` prints.

A connection, the line engine, a dead controller and the server's watch once a second, all on one virtual clock.
"""

from __future__ import annotations

import pytest

from gateway.core.budget import WATCH_S, line_budget
from gateway.faces.modbus.settings import ModbusSettings
from gateway.modbus import mbap
from gateway.modbus.pdu import ReadRequest
from tests.core.test_engine import Registers
from tests.core.virtual_line import make_line
from tests.faults.tcp.virtual import VirtualFace


@pytest.mark.parametrize("dead", [True, False])
@pytest.mark.parametrize("depth", [1, 16, 17, 100, 600])
async def test_a_deep_pipeline_ends_within_the_printed_deadline(depth: int, dead: bool) -> None:
    controller = Registers(1, turnaround_s=0.4)  # slow, but alive
    line = make_line(controller)
    line.run(3.0)
    controller.silent = dead
    device = line.devices[0]
    deadline_s = line_budget(line.engine.settings, [device.map]).reply_deadline_s
    face = VirtualFace(line, ModbusSettings(reply_timeout_s=deadline_s - WATCH_S))
    connection, transport = face.connect()

    kernel = b"".join(  # no two alike, none in memory
        mbap.encode(tid, device.unit_id, ReadRequest(3, 0x8000 + tid, 1).encode()) for tid in range(depth)
    )
    asked_at = line.now
    while line.now < asked_at + 200.0 and transport.closed_at is None and len(transport.replies) < depth:
        for _ in range(20):
            while kernel and transport.reading and transport.closed_at is None:
                piece, kernel = kernel[:2048], kernel[2048:]
                connection.data_received(piece)
            line.run(WATCH_S / 20)
        reason = connection.overdue(line.now)
        if reason is not None and transport.closed_at is None:
            connection.end(reason)
    answered = len(transport.replies)
    if transport.closed_at is None:
        assert answered == depth
    else:
        assert transport.closed_at - asked_at <= deadline_s
        assert face.stats.closed == {"unanswered": 1}
    assert max((at for at, _ in transport.replies.values()), default=asked_at) - asked_at <= deadline_s
    if depth <= 16:
        assert transport.closed_at is None, "what fits into a window is answered"
    connection.connection_lost(None)
    assert answered >= 1
