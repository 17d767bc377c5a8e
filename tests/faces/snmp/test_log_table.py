"""The log table: cells from days, steps in it, views of it, and what a site of 200 full logs costs."""

from __future__ import annotations

import sys
from bisect import bisect_right
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import islice

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.core.daylog import LoggedDay
from gateway.core.site import Site
from gateway.core.stats import DeviceHistoryStats, HistoryStats
from gateway.devices.model import DeviceMap, Value
from gateway.devices.schema import load_map
from gateway.errors import HistoryError, MapError
from gateway.faces.snmp import log_columns
from gateway.faces.snmp.agent import SnmpAgent
from gateway.faces.snmp.layout import layout, shipped_layout
from gateway.faces.snmp.log_keeper import LogKeeper
from gateway.faces.snmp.log_table import MOST_DAYS, LogDays, LogTail, days_of
from gateway.faces.snmp.objects import Syntax
from gateway.faces.snmp.reader import oid
from gateway.faces.snmp.settings import EVERYTHING, Oid, View
from gateway.faces.snmp.wire import object_identifier, value, varbind
from tests.faces.snmp.stub_site import Ask

LAYOUT = shipped_layout()
TABLE = LAYOUT.tables[-1]
BASE: Oid = (*TABLE.base, 1)
MAP = load_map("prostar-mppt")
COLUMNS = {column.name: column.number for column in TABLE.columns}
FULL: dict[str, Value] = {
    "alarms": 1 << 28 | 1,
    "load_faults": 1,
    "array_faults": 1 << 11,
    "battery_voltage_minimum": 11.5,
    "battery_voltage_maximum": 14.4,
    "charge": 12.25,
    "load_charge": 9.5,
    "array_voltage_maximum": 60.5,
    "absorption_time": 3600,
    "equalize_time": 0,
    "float_time": 120,
}


def day(hours: int, values: dict[str, Value] | None = None, written_at: float | None = 1.7e9) -> LoggedDay:
    return LoggedDay(hours, FULL if values is None else values, written_at, None if written_at is None else 1800.0)


def tail_of(*logs: tuple[int, list[LoggedDay]], view: View | None = None) -> LogTail:
    days = LogDays()
    for unit, found in logs:
        days.put(unit, days_of(MAP, found))
    return LogTail(TABLE, days, view)


def after(tail: LogTail, start: Oid) -> tuple[Oid, bytes] | None:
    step = next(tail.steps(start, 0.0), None)
    return None if step is None else (oid(step[0]), step[1])


def walk(tail: LogTail) -> list[Oid]:
    found = [oid(name) for name, _ in tail.steps((), 0.0)]
    at: Oid = ()
    for each in found:
        step = after(tail, at)
        assert step is not None
        at = step[0]
        assert at == each
    assert after(tail, at) is None
    return found


def cell(name: str, hours: int, unit: int = 11) -> Oid:
    return (*BASE, COLUMNS[name], unit, hours)


def test_it_is_the_last_table() -> None:
    assert TABLE.name == "pgwLog"
    assert all(table.base < TABLE.base for table in LAYOUT.tables[:-1])


@pytest.mark.parametrize(
    ("name", "syntax", "expected"),
    [
        ("pgwLogWritten", Syntax.UNSIGNED32, 1_700_000_000),
        ("pgwLogWrittenError", Syntax.UNSIGNED32, 1800),
        ("pgwLogAlarms", Syntax.BITS, b"\x80\x00\x00\x08"),
        ("pgwLogArrayFaults", Syntax.BITS, b"\x00\x10\x00\x00"),
        ("pgwLogBatteryVoltageMinimum", Syntax.INTEGER32, 11500),
        ("pgwLogCharge", Syntax.INTEGER32, 12250),
        ("pgwLogAbsorptionTime", Syntax.UNSIGNED32, 3600),
    ],
)
def test_cells(name: str, syntax: Syntax, expected: int | bytes) -> None:
    tail = tail_of((11, [day(2400)]))
    at = cell(name, 2400)
    expected_varbind = varbind(object_identifier(at), value(syntax, expected))
    assert tail.get(at, 0.0) == expected_varbind
    step = after(tail, cell(name, 2399))
    assert step == (at, expected_varbind)


def test_every_field_of_a_log_has_its_column() -> None:
    assert MAP.log is not None
    fields = {field.name: field.column for field in MAP.log.fields}
    assert fields.pop("hourmeter") is None
    assert sorted(number for number in fields.values() if number is not None) == [*range(4, 4 + len(fields))]


def test_a_value_that_is_none_has_no_cell() -> None:
    few: dict[str, Value] = {"charge": 1e9, "battery_voltage_minimum": float("nan"), "absorption_time": -1}
    tail = tail_of((11, [day(24, few, written_at=None), day(48)]))
    assert [each for each in walk(tail) if each[-1] == 24] == []
    assert tail.get(cell("pgwLogCharge", 24), 0.0) is None
    step = after(tail, cell("pgwLogCharge", 0))
    assert step is not None
    assert step[0] == cell("pgwLogCharge", 48)


def test_a_walk_goes_by_column_device_and_hourmeter() -> None:
    tail = tail_of((21, [day(5)]), (11, [day(24), day(48)]))
    found = walk(tail)
    assert found == sorted(found)
    assert len(found) == 3 * (2 + 11)
    assert found[:3] == [(*BASE, 2, 11, 24), (*BASE, 2, 11, 48), (*BASE, 2, 21, 5)]
    assert all(tail.get(each, 0.0) is not None for each in found)


@given(st.lists(st.integers(0, 6), max_size=6))
def test_a_step_is_to_the_next_cell_wherever_it_begins(arcs: list[int]) -> None:
    tail = tail_of((1, [day(2, {"alarms": 1}), day(4)]), (3, [day(5)]))
    found = walk(tail)
    for start in ((*BASE, *arcs), (*TABLE.base, *arcs), tuple(arcs)):
        at = bisect_right(found, start)
        step = after(tail, start)
        assert (None if step is None else step[0]) == (found[at] if at < len(found) else None)


@pytest.mark.parametrize("arcs", [(), (4,), (4, 11), (4, 11, 24, 0), (4, 12, 24), (99, 11, 24), (4, 11, 25)])
def test_what_is_no_cell_is_not_got(arcs: Oid) -> None:
    assert tail_of((11, [day(24)])).get((*BASE, *arcs), 0.0) is None


def test_new_days_take_the_place_of_the_old() -> None:
    days = LogDays()
    tail = LogTail(TABLE, days)
    days.put(11, days_of(MAP, [day(24)]))
    assert {each[-1] for each in walk(tail)} == {24}
    days.put(11, days_of(MAP, [day(48), day(72)]))
    assert {each[-1] for each in walk(tail)} == {48, 72}
    days.put(11, {})
    assert walk(tail) == []


@pytest.mark.parametrize(
    ("view", "shown"),
    [
        (EVERYTHING, {11, 21}),
        (View(((1, 3, 6, 1, 2, 1),)), set()),
        (View((BASE,), ((*BASE, 4),)), {11, 21}),
        (View((BASE,), ((*BASE, 4, 11),)), {11, 21}),
        (View(((*BASE, 4, 11),)), {11}),
        (View(((*BASE, 4, 11, 24),)), set()),
        (View((BASE,), ((*BASE, 4, 11, 24),)), {11, 21}),
    ],
)
def test_a_view_shows_columns_of_devices_or_nothing(view: View, shown: set[int]) -> None:
    tail = tail_of((11, [day(24)]), (21, [day(24)])).through(view)
    found = walk(tail)
    assert {each[-2] for each in found} == shown
    assert all(view.shows(each) and tail.get(each, 0.0) is not None for each in found)
    hidden = set(walk(tail_of((11, [day(24)]), (21, [day(24)])))) - set(found)
    assert all(tail.get(each, 0.0) is None for each in hidden)


def test_new_days_make_the_next_reply_no_longer_however_many_controllers_there_are() -> None:
    """665,600 cells, and days that come in all the time: a reply costs a few calls a cell, wherever it begins."""
    days = LogDays()
    log = days_of(MAP, [day(24 * number) for number in range(1, MOST_DAYS + 1)])
    for unit in range(1, 201):
        days.put(unit, log)
    tail = LogTail(TABLE, days)
    next(tail.steps(BASE, 0.0))  # the order is made once
    worst = 0
    at: Oid = BASE
    for _ in range(100):
        days.put(1, log)
        calls, steps = calls_of(lambda at=at: list(islice(tail.steps(at, 0.0), 50)))  # type: ignore[misc]
        worst = max(worst, calls)
        at = oid(steps[-1][0])
        at = (*at[:-2], at[-2] + 2, 0) if at[-2] < 199 else (*BASE, at[-3] + 1)
    assert worst < 50 * 40
    assert after(tail, (*BASE, 14, 200, 24 * MOST_DAYS)) is None


def calls_of(work: Callable[[], list[tuple[bytes, bytes]]]) -> tuple[int, list[tuple[bytes, bytes]]]:
    """How many functions some work called, and what it gave."""
    events: Counter[str] = Counter()
    before = sys.getprofile()
    sys.setprofile(lambda _frame, event, _argument: events.update((event,)))
    try:
        result = work()
    finally:
        sys.setprofile(before)
    return events["call"] + events["c_call"], result


class Source:
    """Days of a history that is read at once."""

    def __init__(self) -> None:
        self.days: dict[str, list[LoggedDay]] = {}
        self.asked: list[str] = []
        self.broken = False

    async def newest(self, line: str, device: str, most: int) -> Sequence[LoggedDay]:
        self.asked.append(f"{line} {device}")
        if self.broken:
            raise HistoryError("locked", "busy")
        return self.days.get(device, [])[-most:]


async def test_a_device_is_read_when_its_log_was_harvested(site: Site) -> None:
    source, stats = Source(), HistoryStats()
    keeper = LogKeeper(site, source, stats)
    await keeper.look()
    assert source.asked == []
    stats.devices[11] = DeviceHistoryStats(days=1, harvested_at=5.0)
    source.days["array-1"] = [day(24)]
    await keeper.look()
    await keeper.look()
    assert source.asked == ["shelter-a array-1"]
    assert {each[-2:] for each in walk(LogTail(TABLE, keeper.days))} == {(11, 24)}
    stats.devices[11].days, stats.devices[11].harvested_at = 2, 9.0
    source.broken = True
    await keeper.look()
    source.broken = False
    source.days["array-1"].append(day(48))
    await keeper.look()
    assert {each[-2:] for each in walk(LogTail(TABLE, keeper.days))} == {(11, 24), (11, 48)}


async def test_a_device_is_read_again_when_its_dates_were_moved(site: Site) -> None:
    source, stats = Source(), HistoryStats()
    keeper = LogKeeper(site, source, stats)
    stats.devices[11] = DeviceHistoryStats(days=1, harvested_at=5.0)
    source.days["array-1"] = [day(24)]
    await keeper.look()
    stats.moved += 1
    await keeper.look()
    await keeper.look()
    assert source.asked == ["shelter-a array-1"] * 2


def test_models_that_disagree_about_a_column_are_refused(device_map: DeviceMap) -> None:
    assert device_map.log is not None
    fields = tuple(
        replace(each, name="battery_low") if each.name == "battery_voltage_minimum" else each
        for each in device_map.log.fields
    )
    other = replace(device_map, model="tristar-mppt", log=replace(device_map.log, fields=fields))
    with pytest.raises(MapError, match="tristar-mppt: log field battery_low: column 7 already has another name"):
        layout([device_map, other])


def test_a_model_without_log_adds_no_column(device_map: DeviceMap) -> None:
    assert layout([replace(device_map, log=None)]).tables[-1].columns == log_columns.DATE


@pytest.mark.peer
async def test_snmptable_shows_it(ask: Ask) -> None:
    code, output = await ask("snmptable", "-Ci", "-Cf", "|", "PROSTAR-GATEWAY-MIB::pgwLogTable")
    assert code == 0
    rows = [line.split("|") for line in output.splitlines() if "|" in line]
    assert rows[0] == ["index", *COLUMNS]
    assert [row[0] for row in rows[1:]] == ["11.24", "11.48", "21.24"]
    assert rows[1][1 + list(COLUMNS).index("pgwLogBatteryVoltageMinimum")] == "11500 millivolts"


@pytest.mark.peer
async def test_a_day_that_comes_later_is_found(ask: Ask, agent: SnmpAgent) -> None:
    tail = agent.tree.tails.tails[-1]
    assert isinstance(tail, LogTail)
    name = "PROSTAR-GATEWAY-MIB::pgwLogCharge.21.48"
    for _ in range(2):
        _, output = await ask("snmpget", name)
        assert "No Such Instance" in output
    tail._days.put(21, days_of(MAP, [day(24), day(48)]))
    _, output = await ask("snmpget", name)
    assert output == f"{name} = INTEGER: 12250 milliampere-hours\n"


@pytest.mark.peer
async def test_getbulk_of_several_columns_goes_over_the_end(ask: Ask) -> None:
    _, output = await ask(
        "snmpbulkget",
        "-Cr4",
        "PROSTAR-GATEWAY-MIB::pgwClientExceptions",
        "PROSTAR-GATEWAY-MIB::pgwLogFloatTime.11.24",
    )
    names = [line.split(" = ")[0].rpartition("::")[2] for line in output.splitlines()]
    assert names == [
        "pgwClientExceptions.1",
        "pgwLogFloatTime.11.48",
        "pgwLogWritten.11.24",
        "pgwLogFloatTime.21.24",
        "pgwLogWritten.11.48",
        "pgwLogFloatTime.21.24",
        "pgwLogWritten.21.24",
        "pgwLogFloatTime.21.24",
    ]
    assert output.count("No more variables left") == 2
