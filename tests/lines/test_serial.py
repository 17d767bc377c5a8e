"""The asyncio shell on a real pty: open, serve, lose the port, open it again."""

from __future__ import annotations

import asyncio
import fcntl
import os
import pty
import time
import tty
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path

import pytest

from gateway.clock import SystemClock
from gateway.core.settings import LineSettings, PollSettings
from gateway.core.site import Device, LineState, Outcome
from gateway.core.snapshot import DeviceState
from gateway.devices.plan import poll_plan
from gateway.devices.schema import load_map
from gateway.errors import LineDown, ShuttingDown
from gateway.lines.serial import SerialLine
from gateway.modbus.crc import append_crc, crc_ok
from gateway.modbus.pdu import Function, ReadRequest
from tests.lines.rig import SleepingClock, ask, make_line, running, until
from tests.machine import Stopwatch


class Controller:
    """A pty whose far end answers reads: register `a` reads `a + base`. Not paced: only the shell is tested here."""

    def __init__(self, link: Path, base: int = 0) -> None:
        self.link = link
        self.base = base
        self.master = -1
        self._slave = -1

    def plug(self) -> None:
        """A new pty behind the same link, as a USB adapter that was plugged in again."""
        self.master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self.master, False)
        self.link.unlink(missing_ok=True)
        self.link.symlink_to(os.ttyname(self._slave))
        asyncio.get_running_loop().add_reader(self.master, self._readable)

    def unplug(self) -> None:
        """Both ends close."""
        asyncio.get_running_loop().remove_reader(self.master)
        self.link.unlink(missing_ok=True)
        os.close(self.master)
        os.close(self._slave)
        self.master = -1

    def _readable(self) -> None:
        frame = os.read(self.master, 512)
        if not crc_ok(frame):
            return
        if frame[1] == Function.READ_IDENTIFICATION:
            os.write(self.master, append_crc(bytes([frame[0], frame[1] | 0x80, 1])))
            return
        address, count = int.from_bytes(frame[2:4], "big"), int.from_bytes(frame[4:6], "big")
        words = b"".join(((address + self.base + i) & 0xFFFF).to_bytes(2, "big") for i in range(count))
        payload = words if frame[1] in {3, 4} else bytes((count + 7) // 8)
        os.write(self.master, append_crc(bytes([frame[0], frame[1], len(payload)]) + payload))


@pytest.fixture
async def controller(tmp_path: Path) -> AsyncIterator[Controller]:
    one = Controller(tmp_path / "ttyUSB0")
    one.plug()
    yield one
    if one.master >= 0:
        one.unplug()


@pytest.fixture
def device() -> Device:
    return Device("array-1", 11, 1, load_map("prostar-mppt"))


async def test_a_device_is_polled_and_a_client_read_is_answered(controller: Controller, device: Device) -> None:
    async with running(make_line(controller.link, device)) as line:
        await until(lambda: device.snapshot.state is DeviceState.ONLINE)
        assert await ask(line, device, 0x200, 3) == bytes.fromhex("03 06 0200 0201 0202")
        status = line.status(SystemClock().monotonic())
        assert status.state is LineState.OPEN
        assert line.stats.opens == 1


async def test_an_absent_port_is_named_once_and_taken_when_it_comes(
    tmp_path: Path, device: Device, caplog: pytest.LogCaptureFixture
) -> None:
    late = Controller(tmp_path / "ttyUSB7")
    async with running(make_line(late.link, device)) as line:
        assert isinstance(await ask(line, device, 0), LineDown)
        await until(lambda: "ttyUSB7" in line.status(0.0).error)
        late.plug()
        await until(lambda: device.snapshot.state is DeviceState.ONLINE)
        late.unplug()
    complaints = [message for message in caplog.messages if "no such device" in message]
    assert len(complaints) == 1
    assert "line=shelter-a" in complaints[0]


async def test_an_unplugged_port_takes_the_line_down_within_a_second_and_it_recovers_alone(
    controller: Controller, device: Device
) -> None:
    async with running(make_line(controller.link, device)) as line:
        await until(lambda: device.snapshot.state is DeviceState.ONLINE)
        controller.unplug()
        watch = Stopwatch()
        await until(lambda: line.status(0.0).state is LineState.DOWN)
        assert watch.s < 1.0
        assert device.snapshot.state is DeviceState.STALE
        assert isinstance(await ask(line, device, 0), LineDown)
        controller.plug()
        await until(lambda: device.snapshot.state is DeviceState.ONLINE)
        assert line.stats.opens == 2


async def test_a_busy_port_names_its_holder(controller: Controller, device: Device) -> None:
    holder = os.open(controller.link, os.O_RDWR | os.O_NOCTTY)
    try:
        fcntl.flock(holder, fcntl.LOCK_EX | fcntl.LOCK_NB)
        async with running(make_line(controller.link, device)) as line:
            await until(lambda: "in use by" in line.status(0.0).error)
            os.close(holder)
            holder = -1
            await until(lambda: device.snapshot.state is DeviceState.ONLINE)
    finally:
        if holder >= 0:
            os.close(holder)


async def test_reads_that_wait_when_the_line_stops_end_as_line_down(controller: Controller, device: Device) -> None:
    outcomes: list[Outcome] = []
    async with running(make_line(controller.link, device)) as line:
        await until(lambda: device.snapshot.state is DeviceState.ONLINE)
        for address in range(20):
            request = ReadRequest(Function.READ_HOLDING_REGISTERS, address, 1).encode()
            line.read(device, request, outcomes.append)
    assert len(outcomes) == 20
    assert isinstance(outcomes[-1], LineDown)


async def test_a_mistake_in_the_engine_ends_run_instead_of_hanging_the_line(
    controller: Controller, device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    line = make_line(controller.link, device)

    def broken(_now: float) -> bytes | None:
        raise ArithmeticError("a bug")

    task = asyncio.create_task(line.run())
    await until(lambda: device.snapshot.state is DeviceState.ONLINE)
    monkeypatch.setattr(line._engine, "step", broken)
    with pytest.raises(ArithmeticError):
        await asyncio.wait_for(task, 30)


def open_descriptors() -> int:
    return sum(1 for _ in Path("/proc/self/fd").iterdir())


async def test_replugging_leaks_no_file_descriptor(controller: Controller, device: Device) -> None:
    async with running(make_line(controller.link, device)) as line:
        await until(lambda: device.snapshot.state is DeviceState.ONLINE)
        before = open_descriptors()
        for _ in range(3):
            controller.unplug()
            await until(lambda: line.status(0.0).state is LineState.DOWN)
            controller.plug()
            await until(lambda: line.status(0.0).state is LineState.OPEN)
        assert open_descriptors() == before


def socket_url(port: int) -> str:
    return f"socket://127.0.0.1:{port}"


async def test_rtu_over_tcp_by_a_pyserial_url(controller: Controller, device: Device) -> None:
    """A terminal server in raw mode: bytes are carried both ways between a TCP connection and the pty."""

    async def carry(read: Callable[[], Awaitable[bytes]], write: Callable[[bytes], object]) -> None:
        while data := await read():
            write(data)

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        loop = asyncio.get_running_loop()
        fd = os.open(controller.link, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        loop.add_reader(fd, lambda: writer.write(os.read(fd, 512)))
        try:
            await carry(lambda: reader.read(512), lambda data: os.write(fd, data))
        finally:
            loop.remove_reader(fd)
            os.close(fd)
            writer.close()

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    port = server.sockets[0].getsockname()[1]
    async with running(make_line(socket_url(port), device)) as line:
        await until(lambda: device.snapshot.state is DeviceState.ONLINE)
        assert await ask(line, device, 9, 1) == bytes.fromhex("03 02 0009")
        server.close()
    await server.wait_closed()


async def test_an_unplugged_line_costs_next_to_nothing_and_says_little(
    controller: Controller, device: Device, caplog: pytest.LogCaptureFixture
) -> None:  # F16
    async with running(make_line(controller.link, device)) as line:
        await until(lambda: device.snapshot.state is DeviceState.ONLINE)
        controller.unplug()
        await until(lambda: line.status(0.0).state is LineState.DOWN)
        used, began = time.process_time(), time.monotonic()
        await asyncio.sleep(2.0)
        assert time.process_time() - used < 0.05 * (time.monotonic() - began)
    assert sum("event=line_down" in message for message in caplog.messages) <= 2  # lost, and then not there
    assert not any(record.exc_info for record in caplog.records)


async def test_a_line_that_finishes_waits_for_the_wire_and_for_nothing_else(
    controller: Controller, device: Device
) -> None:
    async with running(make_line(controller.link, device)) as line:
        await until(lambda: device.snapshot.state is DeviceState.ONLINE)
        async with asyncio.timeout(10.0):
            await line.finish()
        assert isinstance(await ask(line, device, 0x200), ShuttingDown)
        assert line.status(0.0).state is LineState.OPEN


async def test_a_line_without_a_port_finishes_at_once(tmp_path: Path, device: Device) -> None:
    line = make_line(tmp_path / "none", device)
    async with asyncio.timeout(10.0):
        await line.finish()
        async with running(line):
            await line.finish()


async def test_only_a_line_that_could_work_and_does_not_is_overdue(controller: Controller, device: Device) -> None:
    async with running(make_line(controller.link, device)) as line:
        later = SystemClock().monotonic() + 1000.0
        assert line.overdue_s(later) == 0.0  # the port is not open
        await until(lambda: device.snapshot.state is DeviceState.ONLINE)
        assert line.overdue_s(SystemClock().monotonic()) < 100.0
        assert line._timer is not None
        line._timer.cancel()  # it stands for a mistake of ours: nobody will call the engine again
        later = SystemClock().monotonic() + 1000.0
        assert line.overdue_s(later) > 900.0
        controller.unplug()
        await until(lambda: line.status(0.0).state is LineState.DOWN)
        assert line.overdue_s(later) == 0.0


async def test_after_the_machine_slept_values_are_read_anew_at_once(
    controller: Controller, device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Although the next poll is an hour of timers away."""
    monkeypatch.setattr("gateway.lines.serial.LONGEST_ALARM_S", 0.05)
    clock = SleepingClock()
    seldom = PollSettings(live_s=3600.0, settings_s=3600.0)
    settings = LineSettings(name="shelter-a", index=1, port=str(controller.link), reply_timeout_s=0.1, poll=seldom)
    async with running(SerialLine(settings, [device], clock)):
        await until(lambda: len(device.snapshot.blocks) == len(poll_plan(device.map)))
        clock.slept_s = 8 * 3600.0
        woke_at = clock.monotonic()
        await until(lambda: all(at >= woke_at for at in device.snapshot.read_at.values()))
        assert device.snapshot.state is DeviceState.ONLINE
