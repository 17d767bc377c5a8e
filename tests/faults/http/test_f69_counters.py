"""F69: a counter of the controller resets, or holds what cannot be (4294934512): withheld, counted, registers as is."""

from __future__ import annotations

from gateway.devices.model import Space
from tests.faults.http.plant import Plant

SEEN_IN_THE_FIELD = 4_294_934_512
CHARGE = "morningstar_charge_amperehours_total"
IMPLAUSIBLE = "prostar_gateway_device_implausible_total"


def raw(plant: Plant, first: int, words: int) -> int:
    """A number as the registers of the live block hold it, which is what a Modbus client gets."""
    [block] = [block for block in plant.device.snapshot.blocks if block.space is Space.REGISTERS and block.first == 0]
    return int.from_bytes(block.data[2 * first : 2 * (first + words)])


def test_an_implausible_counter_is_withheld_and_counted_and_its_registers_stay() -> None:
    plant = Plant()
    plant.run(10.0)
    charge = plant.controller.map.point("charge_total")
    found = plant.scrape()
    before = found[IMPLAUSIBLE]  # erased settings are counted too
    assert found[CHARGE] == 1000

    plant.controller.memory.store(Space.REGISTERS, charge.address, SEEN_IN_THE_FIELD >> 16, SEEN_IN_THE_FIELD & 0xFFFF)
    plant.run(5.0)
    found = plant.scrape()
    assert CHARGE not in found
    assert found[IMPLAUSIBLE] > before
    assert raw(plant, charge.address, charge.words) == SEEN_IN_THE_FIELD
    assert found["morningstar_battery_voltage_volts"] == 12.5, "the rest is not withheld"
    assert found["morningstar_up"] == 1

    plant.controller.memory.set("charge_total", 1001)
    plant.run(5.0)
    assert plant.scrape()[CHARGE] == 1001


def test_a_counter_that_was_cleared_is_shown_as_it_is() -> None:
    plant = Plant()
    plant.run(10.0)
    before = plant.scrape()[IMPLAUSIBLE]
    plant.controller.memory.set("charge_total", 0)
    plant.run(5.0)
    found = plant.scrape()
    assert found[CHARGE] == 0, "rate() and increase() see a reset of the counter"
    assert found[IMPLAUSIBLE] == before
    assert found["morningstar_up"] == 1
