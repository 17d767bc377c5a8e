"""F24: broadcasts (unit id 0). The gateway sends none and answers 0A; there is no setting that changes it."""

from __future__ import annotations

import asyncio
import logging
from pathlib import Path

import pytest

from gateway.core.site import Site
from gateway.core.stats import ModbusServerStats
from gateway.faces.modbus.server import ModbusServer
from gateway.faces.modbus.settings import ModbusSettings
from gateway.modbus import mbap
from gateway.modbus.counters import RtuCounters
from gateway.modbus.rtu import RtuClient, Timing
from tests.faults.pty_rig import running
from tests.faults.rig import MakeRig, read

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


def test_a_broadcast_of_somebody_else_on_the_line_draws_no_reply(
    rig: MakeRig, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.WARNING)
    line = rig()
    line.wire.receive(bytes.fromhex("00 06 E0 00 00 01"), line.now)  # no CRC: heard by nobody
    line.run(1.0)
    assert isinstance(line.ask(0, read(0, 4)), bytes)
    assert line.units[0].writes == []
