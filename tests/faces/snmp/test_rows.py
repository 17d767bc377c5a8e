"""Rows that are made of numbers beside the same rows kept."""

from __future__ import annotations

from typing import NamedTuple

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.core.site import Device
from gateway.devices.schema import load_map
from gateway.faces.snmp import wire
from gateway.faces.snmp.agent import SnmpAgent
from gateway.faces.snmp.objects import EntityRow, RowKind
from gateway.faces.snmp.rows import ARC_BITS, NumberedRows, Rows
from gateway.faces.snmp.settings import Oid

ARCS = st.integers(0, 300) | st.integers(0, 2**32 - 1)
DEVICES = {unit: Device(f"array-{unit}", unit, unit, load_map("prostar-mppt")) for unit in range(1, 248)}


class Both(NamedTuple):
    """The same rows, kept and made."""

    kept: Rows
    made: Rows


def entity(unit: int, number: int, stride: int) -> EntityRow:
    device = DEVICES.get(unit)
    return EntityRow(None, unit * stride + number, 0, device=device)  # type: ignore[arg-type]  # whose it is does not matter


def both(indexes: set[tuple[int, int]], stride: int) -> Both:
    """Rows of units and numbers among their own."""
    two = stride == 1 << ARC_BITS
    kept = Rows(
        ((unit, number) if two else (unit * stride + number,), entity(unit, number, stride)) for unit, number in indexes
    )
    numbers = [unit * stride + number for unit, number in indexes]
    return Both(kept, NumberedRows(numbers, stride, lambda u, n: entity(u, n, stride), DEVICES.get, lambda u: u % 2))


@st.composite
def pairs(draw: st.DrawFn) -> Both:
    stride = draw(st.sampled_from((1000, 1 << ARC_BITS)))
    numbers = st.integers(0, min(stride - 1, 200)) | st.integers(0, stride - 1)
    return both(draw(st.sets(st.tuples(st.integers(0, 247), numbers), max_size=12)), stride)


def same(rows: Both) -> None:
    kept, made = rows
    for start, end in ((0, kept.size), (1, 3)):
        end = min(end, kept.size)  # noqa: PLW2901 - as far as there are rows
        assert made.devices(start, end) == kept.devices(start, end)
    assert made.size == kept.size
    assert list(made.indexes) == list(kept.indexes)
    for at in range(kept.size):
        assert made.row(at) == kept.row(at)
        assert made.suffix(at) == kept.suffix(at)
        assert made.places.get(kept.suffix(at)) == at
        assert made.device(at) is kept.device(at)
        # Of rows that are nobody's, nobody asks where they end.
        assert kept.device(at) is None or made.end(at) == kept.end(at)


@given(rows=pairs(), data=st.data())
def test_the_same_rows_in_the_same_places(rows: Both, data: st.DataObject) -> None:
    same(rows)
    kept, made = rows
    assert made.indexes[1:4] == kept.indexes[1:4]
    if kept.size:
        some = data.draw(st.lists(st.integers(0, kept.size - 1), unique=True))
        same(Both(kept.only(some), made.only(some)))


@given(rows=pairs(), arcs=st.lists(ARCS, max_size=3).map(tuple), data=st.data())
def test_what_is_behind_any_arcs(rows: Both, arcs: Oid, data: st.DataObject) -> None:
    kept, made = rows
    if kept.size:
        near = data.draw(st.sampled_from(list(kept.indexes)))
        arcs = data.draw(
            st.sampled_from((arcs, near, near[:-1], (*near, 0), (*near[:-1], min(near[-1] + 1, 2**32 - 1))))
        )
    assert made.behind(arcs) == kept.behind(arcs)


@given(rows=pairs(), arcs=st.lists(ARCS, max_size=3).map(tuple), suffix=st.binary(max_size=12), data=st.data())
def test_octets_that_are_no_index_are_no_place(rows: Both, arcs: Oid, suffix: bytes, data: st.DataObject) -> None:
    kept, made = rows
    near = kept.suffix(data.draw(st.integers(0, kept.size - 1))) if kept.size else b""
    for octets in (suffix, wire.arcs(arcs), near, b"\x80" + near, near + suffix, near[:-1], near[1:]):
        assert made.places.get(octets) == kept.places.get(octets)


@pytest.mark.parametrize("kind", [RowKind.CONDITION, RowKind.ENTITY])
def test_nothing_is_kept_of_conditions_and_sensors(agent: SnmpAgent, kind: RowKind) -> None:
    names = {RowKind.CONDITION: "pgwConditionState", RowKind.ENTITY: "entPhysicalName"}
    [column] = [column for column in agent.tree.columns if column.object.name == names[kind]]
    assert isinstance(column.rows, NumberedRows)
    assert column.rows.size > 80
