"""Columns of 200 devices: what a cell costs in memory, and how much work one datagram can cause at most."""

from __future__ import annotations

import itertools
import math
import tracemalloc
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import pytest
from pysnmp.proto.api import v2c

from gateway.core.site import Device, Site
from gateway.core.snapshot import Snapshot
from gateway.core.stats import ModbusServerStats
from gateway.devices.model import DeviceMap
from gateway.faces.snmp.agent import SnmpAgent
from gateway.faces.snmp.columns import AlikeColumn, Column, SnapshotColumn, column_of
from gateway.faces.snmp.objects import CellValue, Changes, DeviceRow, Gateway, ObjectType, Syntax
from gateway.faces.snmp.reader import oid as arcs_of
from gateway.faces.snmp.responder import DATAGRAM_LIMIT
from gateway.faces.snmp.rows import Rows
from gateway.faces.snmp.settings import DEFAULT_ROOT, Oid, SnmpSettings
from tests.faces.snmp.stub_site import StubClock, StubLine, online
from tests.faces.snmp.test_responder import LIVE, LOCAL, Reply, request

UNITS = 200
OCTETS_A_CELL = 20
MOST_READ = 7 * UNITS
"""Cells whose value one datagram may read: those of its reply, and those of a few columns that were stepped over."""


@pytest.fixture
def devices(device_map: DeviceMap) -> list[Device]:
    line = StubLine("a", 1, "/dev/ttyA")
    made = [Device(f"d{unit}", unit, unit, device_map) for unit in range(1, UNITS + 1)]
    for device in made:
        device.line = line
        device.snapshot = online(device_map, device.unit_id)
    return made


@pytest.fixture
def make_big(settings: SnmpSettings, devices: list[Device], clock: StubClock) -> Callable[[], SnmpAgent]:
    site = Site.of("big", (devices[0].line,), devices)
    return lambda: SnmpAgent(replace(settings, requests_per_s=1e9), site, clock, ModbusServerStats())


@pytest.fixture
def big(make_big: Callable[[], SnmpAgent]) -> SnmpAgent:
    return make_big()


@pytest.fixture
def reads(big: SnmpAgent) -> list[str]:
    """The names of the objects whose `get` is called, one entry a call."""
    found: list[str] = []

    def watched(described: ObjectType) -> Callable[[Any, float], CellValue]:
        def get(row: object, now: float) -> CellValue:
            found.append(described.name)
            return described.get(row, now)

        return get

    for column in big.tree.columns:
        column.object = replace(column.object, get=watched(column.object))
    return found


def test_a_cell_takes_little_memory_before_and_after_a_walk(
    make_big: Callable[[], SnmpAgent], clock: StubClock
) -> None:
    tracemalloc.start()
    tree = make_big().tree
    made, _ = tracemalloc.get_traced_memory()
    for cell in tree:
        cell.varbind(clock.now)
    walked, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert tree.size > 100_000
    assert made / tree.size < OCTETS_A_CELL
    assert walked / tree.size < OCTETS_A_CELL


def test_what_is_alike_is_what_each_row_says(agent: SnmpAgent, site: Site, clock: StubClock) -> None:
    """Of models that differ, in any order, and again from what was kept."""
    found = [column for column in agent.tree.columns if isinstance(column, AlikeColumn)]
    assert len({device.map.model for device in site.devices}) > 1
    assert len(found) > 8
    for column in found:
        plain = Column(column.base, column.object, column.rows)
        for at in (*range(column.size - 1, -1, -1), *range(column.size)):
            assert column.varbind(at, clock.now) == plain.varbind(at, clock.now)


@pytest.mark.parametrize("root", [DEFAULT_ROOT, (1, 3, 6, 1, 4, 1, *[4294967295] * 20)], ids=["short", "long"])
def test_a_run_of_cells_is_one_cell_after_another(
    make_agent: Callable[..., SnmpAgent], site: Site, clock: StubClock, root: Oid
) -> None:
    """Up to the first without a value, wherever it begins; some devices are silent, some lack some points."""
    tree = make_agent(enterprise_root=root).tree
    for every, device in enumerate(site.devices):
        if every % 3 == 2:
            device.snapshot = Snapshot()
        elif every % 3 == 1:
            values = {name: value for name, value in device.snapshot.values.items() if len(name) % 2}
            device.snapshot = replace(device.snapshot, values={**values, "battery_voltage": math.nan})
    lengths = set()
    for column in tree.columns:
        cells = [column.varbind(at, clock.now) for at in range(column.size)]
        for start in range(column.size + 1):
            wanted = list(itertools.takewhile(lambda each: each is not None, cells[start:]))
            assert column.run(start, column.size, clock.now) == wanted
            assert column.run(start, min(start + 2, column.size), clock.now) == wanted[:2]
            lengths.add(len(wanted))
    assert {0, 1, 2} <= lengths


def hostile_requests(agent: SnmpAgent) -> Iterator[bytes]:
    """As much as fits a datagram, of every kind, spread over the tree and all at its dearest places."""
    starts = [arcs_of(column.name(0)) for column in agent.tree.columns]
    for kind, bulk in (
        (v2c.GetRequestPDU, (0, 0)),
        (v2c.GetNextRequestPDU, (0, 0)),
        (v2c.GetBulkRequestPDU, (0, 2**31 - 1)),
        (v2c.GetBulkRequestPDU, (2**31 - 1, 0)),
    ):
        choices: list[list[Oid]] = [[(1, 3)], [LIVE], starts[:60], starts[60:120], starts[-60:], [(*LIVE, 20)] * 60]
        choices += [[(1, 3)] * 150, starts[::3][:60]]
        for names in choices:
            data = request(kind, *names, bulk=bulk)
            while len(data) > DATAGRAM_LIMIT:
                names.pop()
                data = request(kind, *names, bulk=bulk)
            yield data


@pytest.mark.parametrize("state", ["online", "changed", "silent", "one", "few"])
def test_one_datagram_reads_a_bounded_number_of_cells(
    big: SnmpAgent, devices: list[Device], reads: list[str], state: str
) -> None:
    """Also right after every device changed, or fell silent, at once."""
    whole = [device.snapshot for device in devices]
    for version, data in enumerate(hostile_requests(big), 2):
        for device, snapshot in zip(devices, whole, strict=True):
            if state == "silent" or (state == "one" and device is not devices[-1]):
                device.snapshot = Snapshot()
            elif state == "few":
                device.snapshot = replace(snapshot, version=version, values={"battery_voltage": 12.0})
            elif state == "changed":
                device.snapshot = replace(snapshot, version=version)
        reads.clear()
        reply = big.answer(data, LOCAL)
        assert reply is not None
        assert Reply(reply).status in {0, 1}
        assert len(reads) <= MOST_READ


def test_a_walk_reads_every_cell_once(big: SnmpAgent, reads: list[str], clock: StubClock) -> None:
    at: Oid = (*LIVE[:-2], 4)
    seen = 0
    while at[: len(LIVE) - 1] == LIVE[:-1]:
        reply = Reply(big.answer(request(v2c.GetBulkRequestPDU, at, bulk=(0, 50)), LOCAL) or b"")
        seen += len(reply.names)
        at = reply.names[-1]
    assert seen > 40 * UNITS
    assert len(reads) < seen + 100
    reads.clear()
    for cell in big.tree:
        if cell.oid[: len(LIVE)] == LIVE:
            cell.varbind(clock.now)
    assert reads == []  # the snapshots are the same


def rows_of(devices: list[Device], each: int) -> Rows:
    """So many rows of every device."""
    gateway: Gateway = None  # type: ignore[assignment]
    return Rows(
        ((device.unit_id, number), DeviceRow(gateway, device)) for device in devices for number in range(1, each + 1)
    )


def test_all_rows_of_a_silent_device_are_stepped_over_at_once(devices: list[Device]) -> None:
    rows = rows_of(devices, 40)
    asked: list[int] = []

    def get(row: DeviceRow, _now: float) -> int:
        asked.append(row.device.unit_id)
        return row.device.unit_id

    described = ObjectType(4, "x", Syntax.INTEGER32, "", get, changes=Changes.WITH_SNAPSHOT, of_values=True)
    column = column_of((1, 3, 6, 4), described, rows)
    assert isinstance(column, SnapshotColumn)
    for device in devices[:-1]:
        device.snapshot = Snapshot()
    found = column.first(3, 0.0)
    assert found is not None
    assert rows.indexes[found[0]] == (UNITS, 1)
    assert asked == [UNITS]
    assert column.first(found[0] + 40, 0.0) is None


def test_rows_know_where_those_of_another_device_begin(devices: list[Device]) -> None:
    rows = rows_of(devices[:3], 2)
    assert [rows.end(at) for at in range(rows.size)] == [2, 2, 4, 4, 6, 6]
    some = rows.only([1, 2, 5])
    assert some.indexes == [(1, 2), (2, 1), (3, 2)]
    assert [some.end(at) for at in range(some.size)] == [1, 2, 3]
    assert [some.places.get(some.suffix(at)) for at in range(some.size)] == [0, 1, 2]
    assert Rows([]).size == 0
