"""F18: two adapters without serial numbers swap their names: each line leads to the other's controller.

Both controllers have address 1, as they leave the factory, and are of one model.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from pathlib import Path
from random import Random

import pytest

from gateway.clock import SystemClock
from gateway.core.engine import LineEngine
from gateway.core.requests import Lane
from gateway.core.settings import LineSettings
from gateway.core.site import Device, Outcome
from gateway.core.snapshot import DeviceState
from gateway.devices.model import DeviceMap
from gateway.devices.schema import load_map
from gateway.errors import IdentityUnproven
from gateway.lines.serial import SerialLine
from gateway.modbus.rtu import Timing
from gateway.simulator.device import SimulatedController
from gateway.simulator.line import SimulatedLine
from gateway.simulator.pty import PtyLine
from tests.faults.rig import read


class Pair:
    """Two lines with a controller each, on one clock; `swap` exchanges what the adapters lead to."""

    def __init__(self, device_map: DeviceMap, *, serial_numbers: bool = False) -> None:
        self.now = 1000.0
        self.controllers = [
            SimulatedController(
                device_map, seed=3 + n, plant=None, serial_number=f"0000{n}" if serial_numbers else None
            )
            for n in range(2)
        ]
        self.wires = [SimulatedLine([controller]) for controller in self.controllers]
        self.devices = [Device(f"array-{n}", 10 + n, 1, device_map) for n in range(2)]
        self.engines = [
            LineEngine(LineSettings(f"line-{n}", 1 + n, "virtual"), [device], self.now, Random(n))
            for n, device in enumerate(self.devices)
        ]
        self.open()

    def open(self) -> None:
        for engine in self.engines:
            engine.opened(self.now)

    def close(self) -> None:
        for engine, wire in zip(self.engines, self.wires, strict=True):
            engine.closed("unplugged", self.now)
            wire.clear()

    def swap(self) -> None:
        self.close()
        self.wires.reverse()
        self.open()

    def run(self, seconds: float) -> None:
        end = self.now + seconds
        while self.now < end:
            for engine, wire in zip(self.engines, self.wires, strict=True):
                out = engine.step(self.now)
                if out is not None:
                    wire.receive(out, self.now)
                data = wire.take(self.now)
                if data:
                    engine.receive(data, self.now)
                engine.on_timer(self.now)
            self.now += 0.005

    def hours(self, n: int) -> object:
        return self.devices[n].snapshot.values.get("hourmeter")

    def ask(self, n: int) -> Outcome:
        outcomes: list[Outcome] = []
        self.engines[n].read(self.devices[n], read(0, 4), outcomes.append, self.now, client="", lane=Lane.CLIENT)
        self.run(1.0)
        assert len(outcomes) == 1
        return outcomes[0]


@pytest.fixture
def pair() -> Pair:
    two = Pair(load_map("prostar-mppt"))
    two.run(5.0)
    assert [device.snapshot.state for device in two.devices] == [DeviceState.ONLINE] * 2
    assert two.hours(0) != two.hours(1)
    return two


def test_nothing_of_the_other_controller_is_shown_or_asked_for(pair: Pair, caplog: pytest.LogCaptureFixture) -> None:
    hours = [pair.hours(0), pair.hours(1)]
    pair.swap()
    for _ in range(150):
        pair.run(0.1)
        for n in range(2):
            shown = pair.devices[n].snapshot.shown()
            assert "hourmeter" not in shown or shown["hourmeter"] == hours[n]
    for n, device in enumerate(pair.devices):
        assert device.snapshot.state is not DeviceState.ONLINE
        assert "identity_mismatch" in device.snapshot.warnings
        outcome = pair.ask(n)
        assert isinstance(outcome, IdentityUnproven)
        assert outcome.exception_code == 0x0A
        assert device.stats.identity_mismatches == 1
    alarms = [record for record in caplog.records if "event=identity_mismatch" in record.getMessage()]
    assert [record.levelno for record in alarms] == [logging.ERROR] * 2


def test_the_right_one_is_taken_again_by_itself(pair: Pair) -> None:
    pair.swap()
    pair.run(5.0)
    pair.swap()
    pair.run(5.0)
    for n, device in enumerate(pair.devices):
        assert device.snapshot.state is DeviceState.ONLINE
        assert not device.snapshot.warnings
        assert isinstance(pair.ask(n), bytes)


def test_the_same_controller_behind_another_name_is_welcome(pair: Pair) -> None:
    pair.close()
    pair.run(60.0)
    pair.open()
    pair.run(5.0)
    assert [device.snapshot.state for device in pair.devices] == [DeviceState.ONLINE] * 2


def test_a_serial_number_is_enough_to_tell_two_of_the_same_age_apart() -> None:
    pair = Pair(load_map("prostar-mppt"), serial_numbers=True)
    pair.controllers[1].day = pair.controllers[0].day
    pair.run(5.0)
    assert [device.snapshot.serial_number for device in pair.devices] == ["00000", "00001"]
    pair.swap()
    pair.run(10.0)
    for device in pair.devices:
        assert device.snapshot.state is not DeviceState.ONLINE
        assert "identity_mismatch" in device.snapshot.warnings


class Socket:
    """A line of the gateway on a link, and what is plugged in there."""

    def __init__(self, folder: Path, number: int, device_map: DeviceMap) -> None:
        wire = SimulatedLine([SimulatedController(device_map, seed=3 + number)], timing=Timing.of(115200, 8, "N", 2))
        self.pty = PtyLine(wire, link=folder / f"socket-{number}")
        self.device = Device(f"array-{number}", 10 + number, 1, device_map)
        settings = LineSettings(f"line-{number}", 1 + number, str(self.pty.link), baudrate=115200)
        self.line = SerialLine(settings, [self.device], SystemClock(), Random(number))

    @property
    def state(self) -> DeviceState:
        return self.device.snapshot.state

    @property
    def mismatch(self) -> bool:
        return "identity_mismatch" in self.device.snapshot.warnings


def swap(one: Socket, other: Socket) -> None:
    """Pull both adapters and plug each into the other's socket."""
    one.pty.unplug()
    other.pty.unplug()
    one.pty.link, other.pty.link = other.pty.link, one.pty.link
    one.pty.replug()
    other.pty.replug()


async def test_over_two_ptys(tmp_path: Path) -> None:
    sockets = [Socket(tmp_path, number, load_map("prostar-mppt")) for number in range(2)]
    hours: dict[str, object] = {}

    async def until(condition: Callable[[Socket], bool]) -> None:
        async with asyncio.timeout(30):
            while not all(map(condition, sockets)):  # the snapshot is replaced without an event
                for socket in sockets:
                    shown = socket.device.snapshot.shown().get("hourmeter")
                    assert shown in {None, hours.get(socket.device.name, shown)}
                await asyncio.sleep(0.005)

    for socket in sockets:
        socket.pty.open()
    tasks = [asyncio.create_task(socket.line.run()) for socket in sockets]
    try:
        await until(lambda socket: socket.state is DeviceState.ONLINE)
        hours = {socket.device.name: socket.device.snapshot.values["hourmeter"] for socket in sockets}
        assert len(set(hours.values())) == 2
        swap(*sockets)
        await until(lambda socket: socket.mismatch)
        for socket in sockets:
            assert socket.state is not DeviceState.ONLINE
            answer: asyncio.Future[Outcome] = asyncio.get_running_loop().create_future()
            socket.line.read(socket.device, read(0, 4), answer.set_result)
            assert isinstance(await answer, IdentityUnproven)
        swap(*sockets)
        await until(lambda socket: socket.state is DeviceState.ONLINE and not socket.mismatch)
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        for socket in sockets:
            socket.pty.close()
