"""Fixtures of the simulator's tests: its own plugin, and a client that talks PDUs to one controller."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from gateway.devices.codecs import decode
from gateway.devices.model import DeviceMap, Value
from gateway.simulator.device import SimulatedController
from gateway.simulator.plugin import controller, open_site, oracles, prostar_map, pty_line, simulated_line

__all__ = ["controller", "open_site", "oracles", "prostar_map", "pty_line", "simulated_line"]


class Client:
    """Asks one controller by point names; `now` is the line's time and passes only when a test says so."""

    def __init__(self, controller: SimulatedController) -> None:
        self.controller = controller
        self.now = 0.0
        controller.advance(0.0)

    def ask(self, *pdu: int) -> bytes | None:
        return self.controller.handle(bytes(pdu), self.now)

    def request(self, function: int, address: int, value: int) -> bytes | None:
        return self.controller.handle(
            bytes([function, *address.to_bytes(2, "big"), *value.to_bytes(2, "big")]), self.now
        )

    def words(self, first: int, count: int, function: int = 3) -> list[int]:
        reply = self.request(function, first, count)
        assert reply is not None
        assert reply[:2] == bytes([function, 2 * count])
        return [int.from_bytes(reply[2 + 2 * k : 4 + 2 * k], "big") for k in range(count)]

    def get(self, name: str) -> Value | None:
        point = self.controller.map.point(name)
        if point.space == "coils":
            reply = self.request(1, point.address, 1)
            assert reply is not None
            assert len(reply) == 3
            return reply[2]
        reading = point.reading()
        return decode(reading.codec, self.words(point.address, point.words), reading.order, reading.scale)

    def write(self, name: str, raw: int) -> bytes | None:
        point = self.controller.map.point(name)
        if point.space == "coils":
            return self.request(5, point.address, 0xFF00 if raw else 0x0000)
        return self.request(6, point.address, raw)

    def bit(self, name: str, label: str) -> bool:
        table = self.controller.map.point(name).bits
        assert table is not None
        (number,) = [bit.number for bit in self.controller.map.bit_tables[table] if bit.name == label]
        value = self.get(name)
        assert isinstance(value, int)
        return bool(value >> number & 1)

    def state(self, name: str) -> str:
        table = self.controller.map.point(name).enumeration
        assert table is not None
        value = self.get(name)
        return next(entry.name for entry in self.controller.map.enumerations[table] if entry.number == value)


MakeClient = Callable[..., Client]


@pytest.fixture
def client(controller: SimulatedController) -> Client:
    return Client(controller)


@pytest.fixture
def make_client(prostar_map: DeviceMap) -> MakeClient:
    return lambda **options: Client(SimulatedController(prostar_map, **options))
