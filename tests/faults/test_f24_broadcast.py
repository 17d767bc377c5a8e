"""F24: broadcasts (unit id 0). The gateway sends none and answers 0A; there is no setting that changes it."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from gateway.core.site import Outcome, Site
from gateway.core.stats import ModbusServerStats
from gateway.faces.modbus.server import ModbusServer
from gateway.faces.modbus.settings import ModbusSettings
from gateway.modbus import mbap
from gateway.modbus.counters import RtuCounters
from gateway.modbus.rtu import RtuClient, Timing
from tests.faults.pty_rig import running
from tests.faults.rig import MakeRig, Unit, frame, read

REQUESTS = ("03 0000 0004", "06 E000 0001", "05 0001 FF00", "10 0000 0001 02 0001", "2B 0E 01 00")


async def test_unit_0_is_0a_and_nothing_reaches_the_line(tmp_path: Path) -> None:
    async with running(tmp_path, writes=True) as rig:
        await rig.online()
        stats = ModbusServerStats()
        settings = ModbusSettings(listen=(("127.0.0.1", 0),))
        server = ModbusServer(settings, Site.of("ridge-07", [rig.line], rig.devices), rig.clock, stats)
        (listener,) = server.listeners
        await listener.start()
        sent = rig.line.stats.sent
        try:
            assert listener.bound is not None
            reader, writer = await asyncio.open_connection(*listener.bound)
            for request in REQUESTS:
                pdu = bytes.fromhex(request)
                writer.write(mbap.encode(7, 0, pdu))
                async with asyncio.timeout(30):
                    assert await reader.readexactly(9) == mbap.encode(7, 0, bytes((pdu[0] | 0x80, 0x0A)))
            writer.close()
            await writer.wait_closed()
        finally:
            await listener.stop()
        assert rig.line.stats.sent == sent
        assert rig.units[0].writes == []


def test_no_frame_with_address_0_can_be_sent() -> None:
    client = RtuClient(Timing.of(9600, 8, "N", 2), RtuCounters(), quarantine_s=0.1)
    with pytest.raises(ValueError, match="address 0"):
        client.send(0, bytes.fromhex("06 E000 0001"), 1000.0, 0.5)


def test_a_broadcast_of_somebody_else_is_not_taken_for_the_reply_that_is_waited_for(rig: MakeRig) -> None:
    """Its frame is heard while a read is out, in the middle of the turnaround."""
    line = rig(Unit(0, turnaround_s=0.3), retries=0)
    outcomes: list[Outcome] = []
    line.read(0, read(0, 4), outcomes.append)
    line.run(0.1)
    line.engine.receive(frame(0, read(0, 4)[:1] + b"\x08" + bytes(8)), line.now)
    assert outcomes == []
    line.run(1.0)
    assert [type(outcome) for outcome in outcomes] == [bytes]  # the oracle has judged it
    assert line.engine.stats.failed.total() == line.engine.stats.failed["exception"]
