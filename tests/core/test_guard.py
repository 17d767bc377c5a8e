"""The identity guard at work: nothing of a unit that has not proved to be the expected one is shown or asked for."""

from __future__ import annotations

import pytest

from gateway.core.identity import Identity
from gateway.core.settings import PollSettings
from gateway.core.site import Outcome
from gateway.core.snapshot import IDENTITY_MISMATCH, DeviceState
from gateway.devices.model import Space
from gateway.devices.schema import load_map
from gateway.errors import IdentityUnproven
from gateway.modbus.pdu import Function, ReadRequest, exception_reply
from gateway.simulator.device import SimulatedController
from tests.core.virtual_line import MakeLine, VirtualLine

MAP = load_map("prostar-mppt")
BATTERY_VOLTAGE = ReadRequest(Function.READ_HOLDING_REGISTERS, 0x12, 1).encode()
MINE, OTHERS = "17150342", "17150343"


def state(line: VirtualLine) -> DeviceState:
    return line.devices[0].snapshot.state


def mismatch(line: VirtualLine) -> bool:
    return IDENTITY_MISMATCH in line.devices[0].snapshot.warnings


def test_nobody_reads_a_unit_before_it_told_the_configured_serial_number(virtual_line: MakeLine) -> None:
    line = virtual_line(SimulatedController(MAP, serial_number=OTHERS), expected=Identity(serial_number=MINE))
    outcomes: list[Outcome] = []
    for _ in range(10):
        line.read(line.devices[0], BATTERY_VOLTAGE, outcomes.append)
        line.run(0.2)
    assert mismatch(line)
    assert {type(outcome) for outcome in outcomes} == {IdentityUnproven}


def test_nobody_has_to_wait_for_a_proof_that_is_not_wanted(virtual_line: MakeLine) -> None:
    line = virtual_line(SimulatedController(MAP))
    outcomes: list[Outcome] = []
    line.read(line.devices[0], BATTERY_VOLTAGE, outcomes.append)
    line.run(0.5)
    assert state(line) is DeviceState.UNKNOWN
    assert [isinstance(outcome, bytes) for outcome in outcomes] == [True]


@pytest.mark.parametrize("expected", [Identity(), Identity(serial_number=MINE)], ids=["nothing", "a serial number"])
def test_a_unit_of_another_model_is_not_read_by_the_map_that_is_configured(
    virtual_line: MakeLine, caplog: pytest.LogCaptureFixture, expected: Identity
) -> None:
    """From the start on, when nothing was learnt yet; this one has no serial number where the other model has it."""
    tristar = SimulatedController(load_map("tristar-mppt"))
    line = virtual_line(tristar, expected=expected)
    for _ in range(100):
        line.run(1.0)
        assert state(line) is not DeviceState.ONLINE
    assert mismatch(line)
    assert f'reason="product is {tristar.plant.product}, which is no prostar-mppt"' in caplog.text
    swap(line, SimulatedController(MAP, serial_number=MINE))
    line.run(70.0)
    assert state(line) is DeviceState.ONLINE


class Forgetful(SimulatedController):
    """A unit whose replies to requests that begin with `lost` do not arrive the next `times` times."""

    lost = b""
    times = 0
    code = 0  # answers with this exception instead

    def handle(self, pdu: bytes, now: float) -> bytes | None:
        reply = super().handle(pdu, now)
        if self.times and self.lost and pdu.startswith(self.lost):
            self.times -= 1
            return exception_reply(pdu[0], self.code) if self.code else None
        return reply


def forgetful(lost: bytes, times: int, code: int = 0, **options: object) -> Forgetful:
    unit = Forgetful(MAP, **options)  # type: ignore[arg-type]  # the tests' own calls
    unit.lost, unit.times, unit.code = lost, times, code
    return unit


SERIAL_NUMBER = b"\x03\xe0\x80"
WHO = b"\x2b\x0e"
MANY = 1_000_000


@pytest.mark.parametrize("times", [1, 3, 10])
def test_a_lost_reply_is_no_way_around_the_configured_serial_number(virtual_line: MakeLine, times: int) -> None:
    line = virtual_line(forgetful(SERIAL_NUMBER, times, serial_number=OTHERS), expected=Identity(serial_number=MINE))
    for _ in range(600):
        line.run(1.0)
        assert state(line) is not DeviceState.ONLINE
    assert mismatch(line)


@pytest.mark.parametrize("code", [0x04, 0x05, 0x06])
def test_a_busy_unit_has_not_refused_to_tell_its_serial_number(virtual_line: MakeLine, code: int) -> None:
    unit = forgetful(SERIAL_NUMBER, 2, code, serial_number=OTHERS)
    line = virtual_line(unit, expected=Identity(serial_number=MINE))
    for _ in range(60):
        line.run(1.0)
        assert state(line) is not DeviceState.ONLINE
    assert mismatch(line)


@pytest.mark.parametrize("code", [0x01, 0x02, 0x03])
def test_a_unit_that_has_no_serial_number_is_not_refused_for_it(virtual_line: MakeLine, code: int) -> None:
    line = virtual_line(forgetful(SERIAL_NUMBER, MANY, code), expected=Identity(serial_number=MINE))
    line.run(10.0)
    assert state(line) is DeviceState.ONLINE


def test_a_lost_reply_is_no_way_around_the_configured_product(virtual_line: MakeLine) -> None:
    line = virtual_line(forgetful(WHO, 4), expected=Identity(product="PS-MPPT-99"))
    for _ in range(200):
        line.run(1.0)
        assert state(line) is not DeviceState.ONLINE
    assert mismatch(line)


def test_a_lost_reply_costs_the_right_unit_a_moment_only(virtual_line: MakeLine) -> None:
    line = virtual_line(forgetful(SERIAL_NUMBER, 2, serial_number=MINE), expected=Identity(serial_number=MINE))
    line.run(10.0)
    assert state(line) is DeviceState.ONLINE
    assert line.devices[0].snapshot.serial_number == MINE


@pytest.mark.parametrize(("lost", "before"), [(SERIAL_NUMBER, "serial number"), (WHO, "product")])
def test_what_a_unit_once_told_is_asked_for_until_it_is_told_again_and_that_is_said(
    virtual_line: MakeLine, caplog: pytest.LogCaptureFixture, lost: bytes, before: str
) -> None:
    unit = forgetful(lost, 0, serial_number=MINE)
    line = virtual_line(unit)
    line.run(5.0)
    assert state(line) is DeviceState.ONLINE
    unit.times = MANY
    line.engine.closed("unplugged", line.now)
    line.engine.opened(line.now)
    line.run(600.0)
    assert state(line) is DeviceState.STALE
    assert caplog.text.count(f'event=identity_untold device=array-1 what="{before}"') == 1
    line.sent.clear()
    line.run(600.0)
    assert 8 <= sum(frame[1:].startswith(lost) for _, frame in line.sent) <= 12
    unit.times = 0
    line.run(70.0)
    assert state(line) is DeviceState.ONLINE


@pytest.mark.parametrize("lost", [SERIAL_NUMBER, WHO])
def test_what_a_unit_never_told_is_not_insisted_on(virtual_line: MakeLine, lost: bytes) -> None:
    line = virtual_line(forgetful(lost, MANY, serial_number=MINE))
    line.run(15.0)
    assert state(line) is DeviceState.ONLINE


def swap(line: VirtualLine, unit: SimulatedController) -> None:
    """Pull the cable out of one unit and put it into another."""
    line.wire.stations[:] = [unit]


def reopened(line: VirtualLine, unit: SimulatedController) -> None:
    """The same, with the adapter."""
    line.engine.closed("unplugged", line.now)
    line.run(1.0)
    line.wire.clear()
    swap(line, unit)
    line.engine.opened(line.now)


def pair() -> tuple[SimulatedController, SimulatedController]:
    """Two units that differ in product, serial number and counters."""
    return (
        SimulatedController(MAP, seed=1, serial_number=MINE),
        SimulatedController(MAP, seed=2, serial_number=OTHERS),
    )


def test_the_right_unit_is_known_again_though_nobody_saw_the_other_one_go(virtual_line: MakeLine) -> None:
    mine, other = pair()
    line = virtual_line(mine)
    line.run(5.0)
    reopened(line, other)
    line.run(100.0)
    assert mismatch(line)
    swap(line, mine)
    line.run(70.0)
    assert state(line) is DeviceState.ONLINE
    assert not mismatch(line)
    assert line.devices[0].snapshot.serial_number == MINE


def test_the_right_unit_is_read_as_often_as_before_once_it_is_back(virtual_line: MakeLine) -> None:
    mine, other = pair()
    line = virtual_line(mine)
    line.run(5.0)
    reopened(line, other)
    line.run(100.0)
    swap(line, mine)
    while state(line) is not DeviceState.ONLINE:
        line.run(0.1)
    line.run(3.0)
    assert all(block.read_at > line.now - 2.0 for block in line.devices[0].snapshot.blocks if block.first == 0)


@pytest.mark.parametrize("looks", range(1, 8))
def test_nothing_that_was_read_of_the_other_unit_is_ever_shown(virtual_line: MakeLine, looks: int) -> None:
    mine, other = SimulatedController(MAP, seed=1), SimulatedController(MAP, seed=4)
    other.day.totals.hours_before += 500
    other.memory.set("absorption_voltage", 13.0)
    line = virtual_line(mine)
    line.run(5.0)
    hours, volts = line.devices[0].snapshot.values["hourmeter"], line.devices[0].snapshot.values["absorption_voltage"]
    reopened(line, other)
    line.run(10.0 * looks)
    swap(line, mine)
    for _ in range(1000):
        line.run(0.1)
        shown = line.devices[0].snapshot.shown()
        assert shown.get("hourmeter", hours) == hours
        assert shown.get("absorption_voltage", volts) == volts
    assert state(line) is DeviceState.ONLINE
    assert line.devices[0].snapshot.shown()["absorption_voltage"] == volts


def test_what_the_other_unit_refused_is_read_of_the_right_one_again(virtual_line: MakeLine) -> None:
    mine, other = SimulatedController(MAP, seed=1), SimulatedController(load_map("tristar-mppt"), seed=2)
    line = virtual_line(mine)
    line.run(5.0)
    whole = {(block.first, block.count) for block in line.devices[0].snapshot.blocks}
    reopened(line, other)
    line.run(200.0)
    assert mismatch(line)
    swap(line, mine)
    line.run(70.0)
    assert state(line) is DeviceState.ONLINE
    assert {(block.first, block.count) for block in line.devices[0].snapshot.blocks} == whole


def test_another_unit_costs_the_line_one_look_a_minute(virtual_line: MakeLine) -> None:
    mine, other = pair()
    line = virtual_line(mine)
    line.run(5.0)
    reopened(line, other)
    line.run(100.0)
    used_s = line.engine.stats.busy_s
    line.run(600.0)
    assert line.engine.stats.busy_s - used_s < 0.02 * 600


HALF_A_DAY = PollSettings(live_s=60.0, settings_s=300.0)
RESET = 0xFF


@pytest.mark.parametrize("model", ["prostar-mppt", "tristar-mppt"])
@pytest.mark.parametrize("away_s", [0.0, 3600.0, 40 * 3600.0])
def test_a_unit_that_lost_its_power_is_the_same_though_its_counters_went_back(
    virtual_line: MakeLine, model: str, away_s: float
) -> None:
    """They go on from what EEPROM has, which is written once a day (both documents)."""
    device_map = load_map(model)
    unit = SimulatedController(device_map, seed=1, start_hour=6.0)
    line = virtual_line(unit, poll=HALF_A_DAY, opened=False)
    line.devices[0].map = device_map
    line = VirtualLine(line.engine.settings, line.devices, line.wire, line.now)
    line.engine.opened(line.now)
    line.run(8 * 3600.0)
    before = line.devices[0].snapshot.values["hourmeter"]
    unit.write(Space.COILS, RESET, 1, line.now)
    unit.silent = True
    line.run(240.0)
    assert state(line) is not DeviceState.ONLINE
    line.engine.closed("unplugged", line.now)
    line.now += away_s
    line.engine.opened(line.now)
    unit.silent = False
    line.run(120.0)
    assert not mismatch(line)
    assert state(line) is DeviceState.ONLINE
    after = line.devices[0].snapshot.values["hourmeter"]
    assert after < before or away_s > 4 * 3600
    line.run(3600.0)
    line.engine.closed("unplugged", line.now)
    line.engine.opened(line.now)
    line.run(120.0)
    assert state(line) is DeviceState.ONLINE, "it is known by its new counters from then on"


@pytest.mark.parametrize("behind_ah", [-20.0, 5.0, 20.0, 40.0])
def test_a_twin_of_the_same_age_is_no_unit_that_lost_its_power(virtual_line: MakeLine, behind_ah: float) -> None:
    """Installed on the same day on a like array: only the charge differs, and by less than what a day brings."""
    mine, twin = (SimulatedController(MAP, seed=seed, start_hour=6.0) for seed in (1, 4))
    assert mine.plant == twin.plant
    line = virtual_line(mine, poll=HALF_A_DAY)
    twin.advance(line.now)
    line.run(8.5 * 3600.0)
    twin.advance(line.now)
    assert mine.day.totals.charge_ah - line.devices[0].snapshot.values["stored_charge_total"] > 40.0
    twin.day.totals.charge_ah = mine.day.totals.charge_ah - behind_ah
    twin.day.totals.load_ah = mine.day.totals.load_ah
    twin.memory.set("charge_total", twin.day.totals.charge_ah)
    assert int(twin.day.hours) == int(mine.day.hours)
    reopened(line, twin)
    line.run(120.0)
    assert mismatch(line)
