"""Conditions: a pair for every fault and alarm, what passes by itself, what is counted."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import pytest

from gateway.core import conditions as module
from gateway.core.conditions import Condition, Conditions, ConditionState, Severity, Watch, bit_conditions
from gateway.core.site import Device, LineState, LineStatus, Outcome, Site, Ticket
from gateway.core.snapshot import DeviceState
from gateway.core.stats import LineStats
from gateway.devices.model import DeviceMap, Group, Value
from gateway.devices.schema import load_map, models

CLEAR, RAISED, UNKNOWN = ConditionState.CLEAR, ConditionState.RAISED, ConditionState.UNKNOWN
MAP = load_map("prostar-mppt")
BITS = [(point, bit, condition) for point, bit, condition in bit_conditions(MAP)]


@dataclass
class FakeLine:
    name: str = "a"
    index: int = 1
    port: str = "/dev/ttyA"
    state: LineState = LineState.OPEN
    since: float = 0.0
    stats: LineStats = field(default_factory=LineStats)

    def status(self, now: float) -> LineStatus:
        return LineStatus(self.state, self.since, "", 0, 0.0)

    def read(
        self, device: Device, pdu: bytes, done: Callable[[Outcome], None], *, client: str = "", background: bool = False
    ) -> Ticket:
        raise AssertionError("conditions ask nothing")

    def write(self, device: Device, pdu: bytes, done: Callable[[Outcome], None], *, client: str = "") -> Ticket:
        raise AssertionError("conditions write nothing")


class Plant:
    """One device on one line."""

    def __init__(self, own: tuple[Condition, ...] = (), device_map: DeviceMap = MAP) -> None:
        self.line = FakeLine()
        self.device = Device("d", 7, 1, device_map)
        self.device.line = self.line
        self.conditions = Conditions(Site.of("s", (self.line,), [self.device]), own, 0.0)
        self.now = 0.0

    def becomes(self, **changes: object) -> None:
        """A new snapshot, and a look at it a second later."""
        self.device.snapshot = replace(self.device.snapshot, **changes)  # type: ignore[arg-type]
        self.wait(1.0)

    def shows(self, **values: Value) -> None:
        self.becomes(
            state=DeviceState.ONLINE,
            values={"array_faults": 0, "load_faults": 0, "alarms": 0, "load_state": 1, **values},
            last_reply_at=self.now,
        )

    def wait(self, seconds: float) -> None:
        self.now += seconds
        self.conditions.look(self.now)

    def watch(self, code: int, unit_id: int = 7) -> Watch:
        of = self.conditions.devices[unit_id] if unit_id else self.conditions.gateway
        return of[code]

    def worst(self) -> Severity | None:
        return self.conditions.devices[7].worst

    def changes(self) -> list[tuple[str, ConditionState]]:
        return [(watch.condition.name, watch.state) for watch in self.conditions.take()]


@pytest.mark.parametrize(("point", "bit", "condition"), BITS, ids=[condition.name for _, _, condition in BITS])
def test_every_fault_and_alarm_is_raised_and_cleared_once(point: str, bit: int, condition: Condition) -> None:
    plant = Plant()
    plant.shows()
    plant.changes()
    assert plant.watch(condition.code).state is CLEAR

    plant.shows(**{point: 1 << bit})
    assert plant.changes() == [(condition.name, RAISED)]
    plant.shows(**{point: 1 << bit})
    assert plant.changes() == []
    assert (plant.watch(condition.code).times, plant.watch(condition.code).changed_at) == (1, 2.0)
    assert plant.worst() is condition.severity

    plant.shows()
    assert plant.changes() == [(condition.name, CLEAR)]
    assert plant.worst() is None
    assert sum(plant.conditions.devices[7].active.values()) == 0


@pytest.mark.parametrize("model", models())
def test_every_named_live_bit_of_a_model_is_a_condition_with_its_own_code(model: str) -> None:
    device_map = load_map(model)
    found = list(bit_conditions(device_map))
    live = {point.name: point.bits for point in device_map.points if point.group is Group.LIVE and point.bits}
    assert {(point, bit) for point, bit, _ in found} == {
        (point, bit.number) for point, bits in live.items() for bit in device_map.bit_tables[bits]
    }
    assert len({condition.code for _, _, condition in found}) == len(found)
    assert len({condition.name for _, _, condition in found}) == len(found)
    assert all(100 <= condition.code < 1000 and condition.code // 100 != 4 for _, _, condition in found)


def test_codes_are_those_of_the_notes() -> None:
    codes = {condition.name: condition.code for _, _, condition in BITS}
    assert codes["array_fault_battery_hvd"] == 103
    assert codes["load_fault_short_circuit"] == 200
    assert codes["alarm_setting_changed"] == 328


def test_several_bits_at_once() -> None:
    plant = Plant()
    plant.shows(array_faults=0b1001)
    plant.changes()
    plant.shows(array_faults=0b1100, alarms=1 << 23)
    assert plant.changes() == [
        ("array_fault_overcurrent_phase_1", CLEAR),
        ("array_fault_software_bug", RAISED),
        ("alarm_reset", RAISED),
    ]
    assert dict(plant.conditions.devices[7].active) == {Severity.INFO: 1, Severity.WARNING: 0, Severity.CRITICAL: 2}


def test_nobody_knows_the_faults_of_a_device_that_is_away_and_it_is_not_counted_again() -> None:
    plant = Plant()
    assert plant.watch(103).state is UNKNOWN
    plant.shows(array_faults=1 << 3)
    plant.becomes(state=DeviceState.OFFLINE)
    assert plant.watch(103).state is UNKNOWN
    plant.shows(array_faults=1 << 3)
    assert (plant.watch(103).state, plant.watch(103).times) == (RAISED, 1)
    plant.shows()
    plant.shows(array_faults=1 << 3)
    assert plant.watch(103).times == 2


def test_an_offline_device_is_a_condition_at_once_and_over_when_it_answers() -> None:
    plant = Plant()
    assert plant.watch(401).state is UNKNOWN
    plant.becomes(state=DeviceState.OFFLINE)
    assert plant.watch(401).state is RAISED
    plant.shows()
    assert plant.watch(401).state is CLEAR


def test_a_stale_device_is_one_only_after_a_while() -> None:
    plant = Plant()
    plant.shows()
    plant.becomes(state=DeviceState.STALE, state_since=plant.now)
    plant.wait(module.STALE_S - 2)
    assert plant.watch(401).state is CLEAR
    plant.wait(2)
    assert plant.watch(401).state is RAISED


def test_a_device_is_not_blamed_for_its_line() -> None:
    plant = Plant()
    plant.shows()
    plant.line.state, plant.line.since = LineState.DOWN, plant.now
    plant.becomes(state=DeviceState.STALE, state_since=plant.now)
    plant.wait(10 * module.STALE_S)
    assert plant.watch(401).state is UNKNOWN
    assert plant.watch(1001, 0).state is RAISED
    plant.line.state, plant.line.since = LineState.OPEN, plant.now
    plant.wait(1)
    assert plant.watch(1001, 0).state is CLEAR
    assert plant.watch(401).state is UNKNOWN  # it has time to answer
    plant.shows()
    assert plant.watch(401).state is CLEAR


def test_a_line_that_opens_soon_was_not_down() -> None:
    plant = Plant()
    plant.line.state = LineState.DOWN
    plant.wait(module.DOWN_S - 1)
    assert plant.watch(1001, 0).state is UNKNOWN
    plant.line.state, plant.line.since = LineState.OPEN, plant.now
    plant.wait(0.2)
    assert (plant.watch(1001, 0).state, plant.watch(1001, 0).times) == (CLEAR, 0)


@pytest.mark.parametrize(("name", "code"), [("identity_mismatch", 402), ("slave_control_not_refreshed", 403)])
def test_what_the_gateway_sees_of_a_device(name: str, code: int) -> None:
    plant = Plant()
    plant.becomes(last_reply_at=0.5)
    assert plant.watch(code).state is CLEAR
    plant.becomes(warnings=frozenset({name}))
    assert plant.watch(code).state is RAISED
    plant.becomes(warnings=frozenset())
    assert plant.watch(code).state is CLEAR


@pytest.mark.parametrize(
    ("state", "wanted"),
    [(0, UNKNOWN), (1, CLEAR), (2, CLEAR), (3, RAISED), (4, RAISED), (5, RAISED), (6, UNKNOWN), (7, CLEAR)],
)
def test_the_load_is_disconnected_by_the_states_that_the_map_names(state: int, wanted: ConditionState) -> None:
    plant = Plant()
    plant.shows(load_state=state)
    assert plant.watch(404).state is wanted


def test_a_model_without_load_has_no_such_condition() -> None:
    plant = Plant(device_map=replace(MAP, load=None))
    plant.shows(load_state=3)
    assert 404 not in plant.conditions.devices[7]


def test_what_the_gateway_is_told_of_itself() -> None:
    plant = Plant((module.HISTORY_DOWN, module.NOT_READY))
    gateway = plant.conditions.gateway
    gateway.tell(module.HISTORY_DOWN, raised=True, now=1.0)
    gateway.tell(module.NOT_READY, raised=True, now=1.0, after_s=5.0)
    gateway.tell(module.STATE_DIR, raised=True, now=1.0)  # not one of its conditions
    assert [watch.condition.name for watch in plant.conditions.active()] == ["history_store_down"]
    gateway.tell(module.NOT_READY, raised=True, now=6.0, after_s=5.0)
    assert plant.watch(453, 0).state is RAISED
    gateway.tell(module.NOT_READY, raised=False, now=7.0, after_s=5.0)
    gateway.tell(module.NOT_READY, raised=True, now=8.0, after_s=5.0)
    assert plant.watch(453, 0).state is CLEAR
    gateway.tell(module.HISTORY_DOWN, raised=None, now=9.0)
    assert plant.watch(451, 0).state is UNKNOWN


def test_changes_are_kept_once_a_condition() -> None:
    plant = Plant()
    for _ in range(1000):
        plant.shows(array_faults=1)
        plant.shows()
    changes = plant.conditions.take()
    assert len(changes) == len(set(changes)) <= len(list(plant.conditions))
    assert changes.count(plant.watch(100)) == 1


def test_another_site_goes_on_with_what_is_known_of_the_same_lines_and_devices() -> None:
    plant = Plant((module.HISTORY_DOWN, module.NOT_READY))
    plant.shows(array_faults=1)
    plant.conditions.gateway.tell(module.HISTORY_DOWN, raised=True, now=1.0)
    plant.line.state = LineState.DOWN
    plant.wait(10.0)
    before = {watch.condition.code: watch for watch in plant.conditions}
    other = FakeLine("b", 2)
    new = Device("e", 8, 1, MAP)
    new.line = other
    site = Site.of("s", (plant.line, other), [plant.device, new])
    plant.conditions = Conditions(site, (module.HISTORY_DOWN,), plant.now, plant.conditions)
    gateway = plant.conditions.gateway
    assert plant.conditions.devices[7][100] is before[100]
    assert gateway[451] is before[451]
    assert gateway[1001] is before[1001]
    assert gateway[1002].state is UNKNOWN
    assert 453 not in gateway
    assert {severity.name: count for severity, count in gateway.active.items()} == {
        "INFO": 0,
        "WARNING": 1,
        "CRITICAL": 1,
    }
    plant.line.state = LineState.OPEN
    plant.wait(1.0)
    assert gateway.worst is Severity.WARNING
    assert plant.conditions.devices[8][100].state is UNKNOWN
    moved = Conditions(Site.of("s", (other,), [new]), (module.HISTORY_DOWN,), plant.now, plant.conditions)
    assert list(moved.devices) == [8]
    assert [watch.line for watch in moved.gateway] == [None, other]
    assert 1002 not in moved.gateway


def test_what_changes_while_a_site_is_made_counts_once() -> None:
    """Those who are made go on with what those before them learn until they take their place."""
    plant = Plant((module.HISTORY_DOWN, module.NOT_READY))
    before = plant.conditions
    before.gateway.tell(module.NOT_READY, raised=True, now=0.0)
    made = Conditions(Site.of("s", (plant.line,), [plant.device]), (module.HISTORY_DOWN, module.NOT_READY), 0.0, before)
    before.gateway.tell(module.HISTORY_DOWN, raised=True, now=1.0)
    before.gateway.tell(module.NOT_READY, raised=False, now=1.0)
    assert made.gateway.active == {Severity.INFO: 0, Severity.WARNING: 1, Severity.CRITICAL: 0}
    assert made.gateway.worst is Severity.WARNING
    made.gateway.tell(module.HISTORY_DOWN, raised=False, now=2.0)
    assert set(made.gateway.active.values()) == {0}
    assert made.gateway.worst is None


def test_a_line_has_the_code_of_its_place_in_the_site_whatever_its_index_was_before() -> None:
    """A site is made while the one before it is in use, whose lines have their old indexes until the change."""
    plant = Plant()
    first = FakeLine("b", 1, state=LineState.DOWN)
    made = Conditions(Site.of("s", (first, plant.line), [plant.device]), (), 0.0, plant.conditions)
    plant.line.index = 2
    made.look(10.0)
    assert [(watch.condition.code, watch.line, watch.state) for watch in made.gateway] == [
        (1001, first, RAISED),
        (1002, plant.line, CLEAR),
    ]


def test_a_look_without_news_changes_nothing() -> None:
    plant = Plant()
    plant.shows(array_faults=1)
    plant.conditions.take()
    plant.wait(1e6)
    assert plant.conditions.take() == ()
