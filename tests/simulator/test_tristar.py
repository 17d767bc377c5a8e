"""A simulated TriStar: what its own scaling, its words and its coils say, by its document."""

from __future__ import annotations

import pytest

from gateway.devices.model import Space
from gateway.devices.schema import load_map
from gateway.errors import IllegalDataAddress
from gateway.simulator.device import SimulatedController
from gateway.simulator.plant import plants_of

TRISTAR = load_map("tristar-mppt")
TS_45, TS_60 = plants_of(TRISTAR)
NOW = 1000.0


def unit(plant: object = TS_60, **options: object) -> SimulatedController:
    made = SimulatedController(TRISTAR, plant=plant, **{"start_hour": 12.0, **options})  # type: ignore[arg-type]  # the tests' own calls
    made.advance(NOW)
    return made


def register(made: SimulatedController, address: int, now: float = NOW) -> int:
    return made.read(Space.REGISTERS, address, 1, now)[0]


def volts(made: SimulatedController, address: int) -> float:
    """By the document: n·V_PU·2^-15."""
    whole, fraction = made.read(Space.REGISTERS, 0, 2, NOW)
    raw = register(made, address)
    return (raw - (raw >> 15 << 16)) * (whole + fraction / 65536) / 32768


def amperes(made: SimulatedController, address: int) -> float:
    whole, fraction = made.read(Space.REGISTERS, 2, 2, NOW)
    return register(made, address) * (whole + fraction / 65536) / 32768


@pytest.mark.parametrize(("plant", "nominal"), [(TS_45, 24), (TS_60, 48)], ids=["45", "60"])
def test_the_words_hang_together_by_the_units_own_scaling(plant: object, nominal: int) -> None:
    made = unit(plant)
    battery, current = volts(made, 0x0019), amperes(made, 0x001C)
    assert 0.95 * nominal < battery < 1.25 * nominal
    assert current > 5
    scaling = [hi + lo / 65536 for hi, lo in (made.read(Space.REGISTERS, at, 2, NOW) for at in (0, 2))]
    watts = register(made, 0x003A) * scaling[0] * scaling[1] / 131072
    assert watts == pytest.approx(battery * current, rel=0.01)
    assert volts(made, 0xE000) == pytest.approx(14.4 * nominal / 12, abs=0.01)
    assert volts(made, 0x001B) > battery + 2
    assert register(made, 0x0032) in {5, 6, 7, 8}


def test_two_units_tell_another_scaling_and_mean_the_same() -> None:
    one, two = unit(seed=0), unit(seed=2)
    assert one.read(Space.REGISTERS, 0, 4, NOW) != two.read(Space.REGISTERS, 0, 4, NOW)
    assert volts(one, 0xE001) == pytest.approx(volts(two, 0xE001), abs=0.01)


def test_a_unit_without_the_remote_sensor_says_0x80() -> None:
    assert register(unit(TS_45), 0x0024) == 0x0080
    assert 0 < register(unit(TS_60), 0x0024) < 0x0080


def test_who_it_is() -> None:
    made = unit(serial_number="01234567")
    assert made.read(Space.REGISTERS, 0xE0C0, 4, NOW) == [0x3130, 0x3332, 0x3534, 0x3736]
    assert made.read(Space.REGISTERS, 0xE0CC, 2, NOW) == [1, 0x0101]
    assert register(unit(TS_45), 0xE0CC) == 0
    assert dict(made.identification()) == {0: b"Morningstar Corp.", 1: b"TS-MPPT-60", 2: b"v01.01.13"}


@pytest.mark.parametrize(
    ("space", "address"), [(Space.REGISTERS, 0x1000), (Space.REGISTERS, 0x151B), (Space.COILS, 0x1000)]
)
def test_only_the_60_has_a_network(space: Space, address: int) -> None:
    assert len(unit(TS_60).read(space, address, 1, NOW)) == 1
    with pytest.raises(IllegalDataAddress):
        unit(TS_45).read(space, address, 1, NOW)
    with pytest.raises(IllegalDataAddress):
        unit(TS_45).write(space, address, 1, NOW)


def test_a_setting_that_is_edited_raises_its_fault_until_a_reset() -> None:
    made = unit()
    assert made.write(Space.REGISTERS, 0xE002, 7200, NOW)
    assert register(made, 0x002C) == 1 << 6
    made.write(Space.COILS, 0x0014, 1, NOW)
    assert register(made, 0x002C) == 1 << 6, "clearing the faults does not"
    made.write(Space.COILS, 0x00FF, 1, NOW)
    made.advance(NOW + 60)
    assert register(made, 0x002C, NOW + 60) == 0
    assert register(made, 0xE002, NOW + 60) == 7200


def test_a_current_given_over_modbus_limits_the_charge_and_must_be_given_again() -> None:
    made = unit()
    made.write(Space.REGISTERS, 0x0058, round(10 * 32768 / 80), NOW)
    made.advance(NOW + 30)
    assert register(made, 0x0032, NOW + 30) == 9
    assert amperes(made, 0x001C) == pytest.approx(10, abs=0.1)
    made.advance(NOW + 70)
    assert register(made, 0x002C, NOW + 70) == 1 << 11
    assert register(made, 0x0032, NOW + 70) == 4
    made.write(Space.REGISTERS, 0x0058, 0xFFF0, NOW + 71)
    made.advance(NOW + 100)
    assert register(made, 0x002C, NOW + 100) == 0
    assert register(made, 0x0032, NOW + 100) != 9


def test_zero_does_not_end_slave_control() -> None:
    made = unit()
    made.write(Space.REGISTERS, 0x0059, 0x2600, NOW)
    made.advance(NOW + 30)
    made.write(Space.REGISTERS, 0x0059, 0, NOW + 30)
    made.advance(NOW + 40)
    assert register(made, 0x0032, NOW + 40) == 9
    made.advance(NOW + 95)
    assert register(made, 0x002C, NOW + 95) == 1 << 11


def test_commands_clear_what_they_say() -> None:
    made = unit()
    assert register(made, 0xE08C) < 180
    made.write(Space.COILS, 0x0013, 1, NOW)
    assert made.memory.get("time_since_battery_service") == 0
    assert made.read(Space.REGISTERS, 0x0034, 2, NOW) != [0, 0]
    made.write(Space.COILS, 0x0010, 1, NOW)
    assert made.read(Space.REGISTERS, 0x0034, 2, NOW) == [0, 0]
    assert volts(made, 0x0028) == pytest.approx(volts(made, 0x0029), abs=0.1), "lowest and highest begin anew with it"
    for coil in (0x1000, 0x1001, 0x1002, 0x1003, 0x10FF):
        assert made.write(Space.COILS, coil, 1, NOW)
        assert made.read(Space.COILS, coil, 1, NOW) == [0]


def test_a_day_is_counted_in_watt_hours_and_has_its_flags() -> None:
    made = unit(start_hour=3.0, speed=3600.0)
    made.advance(NOW + 14)  # five in the afternoon
    at = NOW + 14
    assert register(made, 0x0044, at) > 1000
    assert register(made, 0x0046, at) > 0
    assert register(made, 0x0047, at) <= register(made, 0x0048, at)
    reached_float = register(made, 0x004F, at) > 0
    assert bool(register(made, 0x0045, at) & 1 << 2) is reached_float
