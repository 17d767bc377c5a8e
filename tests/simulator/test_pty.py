"""The line as a real serial port, with unrelated clients."""

from __future__ import annotations

import asyncio
import os
import select
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import serial
from pymodbus.client import ModbusSerialClient

from gateway.devices.model import DeviceMap
from gateway.modbus.crc import append_crc, crc_ok
from gateway.simulator.layout import Behaviour, LinePlan, SimulatedSite
from gateway.simulator.line import SimulatedLine
from gateway.simulator.oracle import OracleController
from gateway.simulator.plugin import OpenSite
from gateway.simulator.pty import PtyLine

CHAR = 11 / 9600
READ_82 = append_crc(bytes([1, 3, 0, 0, 0, 82]))
WIRE_S = 177 * CHAR + 3.5 * CHAR + 0.015
BLOCKS = [(0x0000, 82), (0x8000, 112), (0x8F80, 128 - 3), (0xE000, 80)]


@pytest.fixture
def oracle(prostar_map: DeviceMap) -> OracleController:
    return OracleController(prostar_map)


def target(link: str) -> Path | None:
    """Where a link leads now; None when it is gone."""
    path = Path(link)
    return path.readlink() if path.is_symlink() else None


def descriptors() -> int:
    return len(list(Path("/proc/self/fd").iterdir()))


def exchange(port: serial.Serial, request: bytes, size: int) -> tuple[bytes, list[float]]:
    """Write a request, read `size` bytes; the reply and the time of each byte since the write."""
    begun = time.monotonic()
    port.write(request)
    reply, times = b"", []
    while len(reply) < size:
        data = port.read(1)
        if not data:
            break
        reply += data
        times.append(time.monotonic() - begun)
    return reply, times


async def test_bytes_never_arrive_faster_than_the_wire(oracle: OracleController, tmp_path: Path) -> None:
    async with PtyLine(SimulatedLine([oracle], wake_bytes=8), link=tmp_path / "line") as line:
        with serial.Serial(line.path, 9600, stopbits=2, timeout=2.0) as port:
            reply, times = await asyncio.to_thread(exchange, port, READ_82, 169)
    assert crc_ok(reply)
    first = 8 * CHAR + 3.5 * CHAR + 0.015
    early = [at - (first + (k + 1) * CHAR) for k, at in enumerate(times)]
    assert min(early) > -0.0005
    assert times[-1] < WIRE_S + 10.0  # how late depends on the machine, how early does not


async def test_the_port_is_raw_and_eight_bit_clean(oracle: OracleController) -> None:
    async with PtyLine(SimulatedLine([oracle])) as line:
        descriptor = os.open(line.path, os.O_RDWR | os.O_NOCTTY)
        try:
            await asyncio.to_thread(os.write, descriptor, READ_82)
            reply = b""
            while len(reply) < 169:
                reply += await asyncio.to_thread(os.read, descriptor, 4096)
        finally:
            os.close(descriptor)
    assert reply[3:-2] == b"".join(oracle.word(k).to_bytes(2, "big") for k in range(82))


async def test_pymodbus_reads_what_each_device_holds(open_site: OpenSite) -> None:
    site = open_site((LinePlan("a", (1, 2)), LinePlan("b", (1,))), Behaviour(oracle=True, turnaround_s=0.005))

    def read_all(port: str, unit: OracleController) -> None:
        with ModbusSerialClient(port, baudrate=9600, stopbits=2, timeout=2, retries=0) as client:
            for first, count in BLOCKS:
                reply = client.read_holding_registers(first, count=count, device_id=unit.address)
                assert reply.registers == [unit.word(first + k) for k in range(count)]
            assert client.read_coils(0, count=256, device_id=unit.address).bits == [unit.coil(k) for k in range(256)]
            assert client.read_holding_registers(0x0051, count=2, device_id=unit.address).exception_code == 2

    for line in site.lines:
        for unit in line.line.stations:
            assert isinstance(unit, OracleController)
            await asyncio.to_thread(read_all, line.path, unit)
        assert line.line.counters.bad_frames == 0


@pytest.mark.peer
async def test_mbpoll_reads_the_simulated_controller(pty_line: PtyLine, peer: Callable[[str], str]) -> None:
    setting = ("-m", "rtu", "-b", "9600", "-P", "none", "-s", "2", "-a", "1")
    wanted = ("-t", "4:hex", "-0", "-r", "0", "-c", "82", "-1", "-q")
    program = await asyncio.create_subprocess_exec(
        peer("mbpoll"), *setting, *wanted, pty_line.path, stdout=asyncio.subprocess.PIPE
    )
    output, _ = await program.communicate()
    assert program.returncode == 0
    lines = [line.split() for line in output.decode().splitlines() if line.startswith("[")]
    assert len(lines) == 82
    assert lines[0] == ["[0]:", "0x0013"]
    assert pty_line.line.counters.replies == 1


async def test_clients_come_and_go_without_hanging_the_line_up(pty_line: PtyLine) -> None:
    for _ in range(3):
        with serial.Serial(pty_line.path, 9600, stopbits=2, timeout=2.0, exclusive=True) as port:
            reply, _ = await asyncio.to_thread(exchange, port, READ_82, 169)
            assert crc_ok(reply)


async def test_unplug_hangs_the_client_up_and_replug_moves_the_link(pty_line: PtyLine) -> None:
    before = target(pty_line.path)
    with serial.Serial(pty_line.path, 9600, stopbits=2, timeout=2.0) as port:
        pty_line.unplug()
        assert not pty_line.plugged
        assert target(pty_line.path) is None
        with pytest.raises((serial.SerialException, OSError)):
            exchange(port, READ_82, 169)
        pty_line.replug()
        assert target(pty_line.path) != before
    with serial.Serial(pty_line.path, 9600, stopbits=2, timeout=2.0) as port:
        reply, _ = await asyncio.to_thread(exchange, port, READ_82, 169)
    assert crc_ok(reply)


async def test_unplugging_twice_and_closing_are_harmless(pty_line: PtyLine) -> None:
    pty_line.unplug()
    pty_line.unplug()
    pty_line.close()
    assert not pty_line.plugged


async def test_without_a_link_an_unplugged_line_has_no_path(oracle: OracleController) -> None:
    line = PtyLine(SimulatedLine([oracle]))
    with pytest.raises(OSError, match="unplugged"):
        _ = line.path
    line.open()
    assert line.path.startswith("/dev/pts/")
    line.close()


async def test_a_reply_cut_by_an_unplug_is_not_heard_after_it(pty_line: PtyLine) -> None:
    with serial.Serial(pty_line.path, 9600, stopbits=2, timeout=2.0) as port:
        port.write(READ_82)
        assert await asyncio.to_thread(port.read, 1) == READ_82[:1]
        pty_line.replug()
    with serial.Serial(pty_line.path, 9600, stopbits=2, timeout=2.0) as port:
        reply, _ = await asyncio.to_thread(exchange, port, READ_82, 169)
    assert crc_ok(reply)


async def test_replies_nobody_reads_are_lost_and_counted(
    oracle: OracleController, caplog: pytest.LogCaptureFixture
) -> None:
    oracle.turnaround_s = 0.0
    line = PtyLine(SimulatedLine([oracle], wake_bytes=10_000))
    async with line:
        descriptor = os.open(line.path, os.O_RDWR | os.O_NOCTTY)
        try:
            os.set_blocking(descriptor, False)
            line._write(line._master or 0, bytes(100_000))
        finally:
            os.close(descriptor)
    assert 0 < line.lost_bytes < 100_000
    assert "nobody reads the simulated line" in caplog.text


async def test_descriptors_do_not_leak(pty_line: PtyLine) -> None:
    before = descriptors()
    for _ in range(20):
        pty_line.replug()
    assert descriptors() == before


async def test_a_line_that_nobody_uses_wakes_for_nothing(pty_line: PtyLine) -> None:
    assert pty_line._master is not None
    for _ in range(2):
        with serial.Serial(pty_line.path, 9600, stopbits=2, timeout=2.0) as port:
            await asyncio.to_thread(exchange, port, READ_82, 169)
        assert pty_line._timer is None
        assert select.select([pty_line._master], [], [], 0) == ([], [], [])


async def test_a_site_that_cannot_open_leaves_nothing_behind(prostar_map: DeviceMap, tmp_path: Path) -> None:
    (tmp_path / "shelter-b").mkdir()
    (tmp_path / "shelter-b" / "taken").touch()
    site = SimulatedSite.build(prostar_map, link_dir=tmp_path)
    with pytest.raises(OSError, match="shelter-b"):
        site.open()
    assert not any(line.plugged for line in site.lines)
    assert target(str(tmp_path / "shelter-a")) is None
    assert (tmp_path / "shelter-b" / "taken").exists()
