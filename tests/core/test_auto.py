"""A device whose model is found by what it says of itself, and what becomes of one that no map knows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import pytest

from gateway.core.identity import Identity
from gateway.core.serving import Ask, Serving
from gateway.core.settings import LineSettings
from gateway.core.site import Device, Outcome, Site
from gateway.core.snapshot import IDENTITY_MISMATCH, UNKNOWN_MODEL, DeviceState
from gateway.devices.model import DeviceMap
from gateway.devices.schema import load_map
from gateway.devices.unknown import UNKNOWN
from gateway.errors import IdentityUnproven, IllegalFunction
from gateway.modbus.pdu import ReadRequest, exception_reply, parse_read
from gateway.simulator.device import SimulatedController
from gateway.simulator.line import SimulatedLine, Station
from gateway.simulator.plant import plants_of
from tests.core.virtual_line import VirtualLine

PROSTAR, TRISTAR = load_map("prostar-mppt"), load_map("tristar-mppt")
TS_45, TS_60 = plants_of(TRISTAR)
BATTERY_REGULATION = ReadRequest(3, 0x0018, 1).encode()


class Stranger(SimulatedController):
    """A ProStar that calls itself something else; `code` is how it answers instead, as often as `times`."""

    def __init__(self, product: str = "SS-MPPT-15L", code: int = 0, times: int = 1_000_000) -> None:
        super().__init__(PROSTAR, plant=replace(plants_of(PROSTAR)[0], product=product))
        self._code, self._times = code, times

    def handle(self, pdu: bytes, now: float) -> bytes | None:
        if pdu[0] == 0x2B and self._code and self._times > 0:
            self._times -= 1
            return exception_reply(0x2B, self._code)
        return super().handle(pdu, now)


class LateTriStar(SimulatedController):
    """One that fails to say what it is the first two times."""

    failures = 2

    def __init__(self) -> None:
        super().__init__(TRISTAR, plant=TS_60, serial_number="16470000")

    def handle(self, pdu: bytes, now: float) -> bytes | None:
        if pdu[0] == 0x2B and self.failures:
            self.failures -= 1
            return exception_reply(0x2B, 4)
        return super().handle(pdu, now)


def auto_line(
    *stations: Station, decode: Mapping[str, str] | None = None, expected: Identity | None = None
) -> VirtualLine:
    """A line whose devices are all to be found."""
    devices = [
        Device(
            f"array-{index}",
            10 + index,
            station.address,
            UNKNOWN,
            dict(decode or {}),
            expected or Identity(),
            auto=True,
        )
        for index, station in enumerate(stations, 1)
    ]
    line = VirtualLine(LineSettings("line", 1, "virtual"), devices, SimulatedLine(stations), start=1000.0)
    line.engine.opened(line.now)
    return line


def blocks_read(line: VirtualLine) -> set[tuple[int, int]]:
    """First address and count of every read of registers that was sent."""
    found = set()
    for _, frame in line.sent:
        if frame[1] == 3:
            read = parse_read(frame[1:-2])
            found.add((read.address, read.count))
    return found


@pytest.mark.parametrize(
    ("device_map", "seed", "value"),
    [(PROSTAR, 0, "load_voltage"), (TRISTAR, 0, "voltage_scaling"), (TRISTAR, 1, "alarms")],
)
def test_the_model_follows_from_the_identification(device_map: DeviceMap, seed: int, value: str) -> None:
    line = auto_line(SimulatedController(device_map, seed=seed))
    (device,) = line.devices
    assert device.map is UNKNOWN
    line.run(4.0)
    assert device.map is device_map
    assert device.snapshot.state is DeviceState.ONLINE
    assert value in device.snapshot.shown()
    assert UNKNOWN_MODEL not in device.snapshot.warnings


def test_two_models_are_found_on_one_line() -> None:
    line = auto_line(SimulatedController(PROSTAR, address=1), SimulatedController(TRISTAR, address=2, plant=TS_60))
    site = Site.of("ridge", (), line.devices)
    before = site.outdated
    line.run(6.0)
    assert [device.map for device in line.devices] == [PROSTAR, TRISTAR]
    assert [device.snapshot.state for device in line.devices] == [DeviceState.ONLINE] * 2
    assert line.devices[1].snapshot.serial_number == "16470000"
    assert line.devices[1].snapshot.shown_texts()["ip_address"] == "192.168.1.1"
    assert (before, site.outdated) == (False, True)
    assert not Site.of("ridge", (), line.devices).outdated


@pytest.mark.parametrize(("plant", "asked"), [(TS_60, True), (TS_45, False)], ids=["60", "45"])
def test_what_the_product_lacks_is_not_asked_for(plant: object, *, asked: bool) -> None:
    line = auto_line(SimulatedController(TRISTAR, plant=plant))  # type: ignore[arg-type]  # one of two plants
    line.run(8.0)
    assert ((0x1000, 0x31) in blocks_read(line)) is asked
    assert ((0x151B, 7) in blocks_read(line)) is asked
    assert {(0x0000, 0x5C), (0xE000, 0x22), (0xE080, 0x4E)} <= blocks_read(line)
    assert line.devices[0].stats.exceptions == 0


@pytest.mark.parametrize("code", [0, 1, 4], ids=["another product", "no identification", "a failure"])
def test_what_no_map_knows_is_online_and_served_raw(code: int) -> None:
    line = auto_line(Stranger(code=code))
    (device,) = line.devices
    line.run(20.0)
    assert device.map is UNKNOWN
    assert device.snapshot.state is DeviceState.ONLINE
    assert device.snapshot.warnings == {UNKNOWN_MODEL}
    assert not device.snapshot.values
    assert not device.snapshot.blocks
    assert 2 <= len(line.sent) <= 6, "it is asked who it is now and then, and nothing else"
    reply = line.ask(device, ReadRequest(3, 0, 2).encode())
    assert isinstance(reply, bytes)
    assert reply[:2] == b"\x03\x04"
    assert line.ask(device, ReadRequest(1, 0, 3).encode())[:2] == b"\x01\x01"  # type: ignore[index]  # a reply
    outcomes: list[Outcome] = []
    line.write(device, bytes.fromhex("06 e000 0000"), outcomes.append)
    line.run(0.5)
    assert isinstance(outcomes[0], IllegalFunction)


def test_strict_map_does_not_keep_an_unknown_model_from_its_registers() -> None:
    line = auto_line(Stranger())
    line.run(2.0)
    serving = Serving(line.devices[0], max_age_s=5.0, strict_map=True)
    assert isinstance(serving.answer(ReadRequest(4, 0xE080, 4).encode(), line.now), Ask)


def test_one_that_goes_away_is_offline_and_found_when_it_comes_back() -> None:
    station = SimulatedController(TRISTAR)
    line = auto_line(station)
    (device,) = line.devices
    line.wire.stations.clear()
    line.run(30.0)
    assert (device.snapshot.state, device.map) == (DeviceState.OFFLINE, UNKNOWN)
    line.wire.stations.append(station)
    line.run(70.0)
    assert (device.snapshot.state, device.map) == (DeviceState.ONLINE, TRISTAR)


def test_one_that_is_busy_is_not_unknown() -> None:
    line = auto_line(Stranger("PS-MPPT-25M", code=6, times=2))
    (device,) = line.devices
    line.run(3.0)
    assert (device.map, device.snapshot.warnings) == (UNKNOWN, frozenset())
    line.run(12.0)
    assert (device.map, device.snapshot.state) == (PROSTAR, DeviceState.ONLINE)


def test_one_that_could_not_say_what_it_is_is_taken_when_it_can() -> None:
    line = auto_line(Stranger("PS-MPPT-25M", code=4, times=2))
    (device,) = line.devices
    line.run(3.0)
    assert device.snapshot.warnings == {UNKNOWN_MODEL}
    line.run(12.0)
    assert (device.map, device.snapshot.warnings) == (PROSTAR, frozenset())
    assert device.snapshot.state is DeviceState.ONLINE


@pytest.mark.parametrize("own", [PROSTAR, TRISTAR], ids=lambda device_map: device_map.model)
def test_another_model_in_its_place_is_another_unit_and_its_own_comes_back_whole(own: DeviceMap) -> None:
    units = {PROSTAR.model: SimulatedController(PROSTAR), TRISTAR.model: SimulatedController(TRISTAR, plant=TS_60)}
    mine = units.pop(own.model)
    (other,) = units.values()
    line = auto_line(mine)
    (device,) = line.devices
    line.run(5.0)
    before = blocks_read(line)
    line.engine.closed("unplugged", line.now)
    line.wire.stations[:] = [other]
    line.engine.opened(line.now)
    line.run(10.0)
    assert device.map is own
    assert device.snapshot.warnings == {IDENTITY_MISMATCH}
    assert not device.snapshot.shown()
    assert isinstance(line.ask(device, BATTERY_REGULATION), IdentityUnproven)
    line.engine.closed("unplugged", line.now)
    line.wire.stations[:] = [mine]
    line.engine.opened(line.now)
    line.sent.clear()
    line.run(10.0)
    assert (device.snapshot.state, device.snapshot.warnings) == (DeviceState.ONLINE, frozenset())
    assert before - {(0xE080, 4)} <= blocks_read(line), "what the other unit refused is asked for again"


@pytest.mark.parametrize(
    "other", [Stranger("SS-MPPT-20L"), SimulatedController(TRISTAR, plant=TS_60)], ids=["stranger", "known"]
)
def test_another_unit_in_the_place_of_one_that_no_map_knows_is_noticed(other: SimulatedController) -> None:
    """Nobody saw it go: what it says it is, is all that there is to know it by, and is asked for all the time."""
    mine = Stranger()
    line = auto_line(mine)
    (device,) = line.devices
    line.run(4.0)
    assert (device.snapshot.state, set(device.snapshot.warnings)) == (DeviceState.ONLINE, {UNKNOWN_MODEL})
    line.wire.stations[:] = [other]
    line.run(15.0)
    assert device.map is UNKNOWN
    assert (device.snapshot.state, set(device.snapshot.warnings)) == (
        DeviceState.STALE,
        {UNKNOWN_MODEL, IDENTITY_MISMATCH},
    )
    assert isinstance(line.ask(device, BATTERY_REGULATION), IdentityUnproven)
    line.wire.stations[:] = [mine]
    line.run(70.0)
    assert (device.snapshot.state, set(device.snapshot.warnings)) == (DeviceState.ONLINE, {UNKNOWN_MODEL})


def test_a_unit_that_is_not_the_configured_product_does_not_become_its_model() -> None:
    line = auto_line(SimulatedController(TRISTAR, plant=TS_60), expected=Identity(product="TS-MPPT-45"))
    (device,) = line.devices
    line.run(8.0)
    assert device.map is UNKNOWN
    assert IDENTITY_MISMATCH in device.snapshot.warnings
    assert device.snapshot.state is not DeviceState.ONLINE


@pytest.mark.parametrize("number", ["16470000", "16470001"], ids=["its own", "another"])
def test_one_that_could_not_say_what_it_is_still_has_to_tell_the_configured_serial_number(number: str) -> None:
    """As long as its model is not known it cannot be asked for one, and is served raw."""
    line = auto_line(LateTriStar(), expected=Identity(serial_number=number))
    (device,) = line.devices
    line.run(3.0)
    assert device.snapshot.warnings == {UNKNOWN_MODEL}
    assert device.snapshot.state is DeviceState.ONLINE
    for _ in range(400):
        line.run(0.1)
        assert not device.snapshot.shown() or device.snapshot.serial_number == number
    is_mine = number == "16470000"
    assert device.map is TRISTAR
    assert (device.snapshot.state is DeviceState.ONLINE) is is_mine
    assert (IDENTITY_MISMATCH in device.snapshot.warnings) is not is_mine
    assert isinstance(line.ask(device, BATTERY_REGULATION), bytes if is_mine else IdentityUnproven)


def test_readings_of_either_model_may_be_chosen_and_those_that_it_has_are_taken() -> None:
    decode = {"hourmeter": "lo_hi", "charge_energy_total": "f16", "load_lvd_warning_time": "seconds"}
    line = auto_line(SimulatedController(TRISTAR), decode=decode)
    line.run(5.0)
    values = line.devices[0].snapshot.values
    assert values["charge_energy_total"] == int(values["charge_energy_total"]), "a TriStar has no such reading"
    assert values.get("hourmeter") != SimulatedController(TRISTAR).memory.get("hourmeter")


def test_what_is_told_of_the_scaling_is_read_anew_when_the_line_is_opened_again() -> None:
    """The settings are in another block than the scaling: they wait for it, and follow it."""
    line = auto_line(SimulatedController(TRISTAR, plant=TS_60, seed=0))
    (device,) = line.devices
    line.run(6.0)
    first = device.snapshot.values
    assert first["absorption_voltage"] == pytest.approx(57.6, abs=0.01)
    line.engine.closed("unplugged", line.now)
    line.wire.stations[:] = [SimulatedController(TRISTAR, plant=TS_60, seed=2, serial_number="16470000")]
    line.engine.opened(line.now)
    line.run(6.0)
    second = device.snapshot.values
    assert second["voltage_scaling"] != first["voltage_scaling"]
    assert second["absorption_voltage"] == pytest.approx(57.6, abs=0.01)


@pytest.mark.parametrize(("end", "warned"), [("fff0", False), ("0000", True)])
def test_slave_control_of_a_tristar_ends_with_a_negative_value_and_not_with_zero(end: str, *, warned: bool) -> None:
    station = SimulatedController(TRISTAR, start_hour=12.0)
    device = Device("array-1", 11, 1, TRISTAR)
    line = VirtualLine(
        LineSettings("line", 1, "virtual", writes=True), [device], SimulatedLine([station]), start=1000.0
    )
    line.engine.opened(line.now)
    line.run(5.0)
    line.write(device, bytes.fromhex("06 0059 2800"), lambda _outcome: None)
    line.run(5.0)
    assert station.memory.get("charge_state") == 9
    line.write(device, bytes.fromhex(f"06 0059 {end}"), lambda _outcome: None)
    line.run(50.0)
    assert ("slave_control_not_refreshed" in device.snapshot.warnings) is warned
    line.run(20.0)
    faults = station.memory.get("array_faults")
    assert faults == (1 << 11 if warned else 0)
    assert station.memory.get("charge_state") == (4 if warned else 5)
