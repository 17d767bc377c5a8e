"""F63: floats become integers of named sub-units; what does not fit is no instance, and never another number."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from pysnmp.proto.api import v2c

from gateway.core.site import Site
from gateway.faces.snmp.agent import SnmpAgent
from gateway.faces.snmp.objects import RANGES, ObjectType
from gateway.faces.snmp.settings import Oid
from tests.faces.snmp.test_responder import LOCAL, Reply, request

fixed = settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=200)
FLOATS = st.one_of(st.floats(), st.floats(width=16), st.integers(-(2**33), 2**33).map(lambda number: number / 1000))


def columns(agent: SnmpAgent) -> dict[str, tuple[Oid, ObjectType]]:
    """Of the points with a scale: OID of the cell of device 11, and what it is."""
    return {
        column.object.point: ((*column.base, 11), column.object)
        for column in agent.tree.columns
        if column.object.point is not None and column.object.syntax in RANGES and column.object.convention is None
    }


class Face:
    """An agent and what it shows."""

    def __init__(self, agent: SnmpAgent, site: Site) -> None:
        self.agent = agent
        self.site = site


@pytest.fixture
def face(agent: SnmpAgent, site: Site) -> Face:
    return Face(agent, site)


def ask(agent: SnmpAgent, kind: type, name: Oid) -> tuple[Oid, Any]:
    reply = Reply(agent.answer(request(kind, name), LOCAL) or b"")
    assert reply.status == 0
    return reply.names[0], reply.values[0]


def set_to(site: Site, point: str, value: float) -> None:
    device = site.by_unit[11]
    snapshot = device.snapshot
    device.snapshot = replace(snapshot, version=snapshot.version + 1, values={**snapshot.values, point: value})


@fixed
@given(value=FLOATS)
@example(value=math.nan)
@example(value=math.inf)
@example(value=-math.inf)
@example(value=2147483.647)
@example(value=2147483.648)
@example(value=-2147483.648)
@example(value=-2147483.649)
@example(value=-0.0)
@example(value=65504.0)  # the greatest half-precision float
@example(value=-0.0004)
@example(value=1.7e308)  # finite, and its sub-units are not
def test_every_float_is_its_number_or_no_instance(face: Face, value: float) -> None:
    agent, site = face.agent, face.site
    for point in ("battery_voltage", "battery_current_net", "charge_resettable", "temperature_compensation"):
        name, described = columns(agent)[point]
        scale = next(each.mib.scale for each in site.by_unit[11].map.points if each.name == point and each.mib)
        set_to(site, point, value)
        low, high = RANGES[described.syntax]
        found, shown = ask(agent, v2c.GetRequestPDU, name)
        assert found == name
        if math.isfinite(value * scale) and low <= round(value * scale) <= high:
            assert int(shown.getComponent().getComponent()) == round(value * scale)
        else:
            assert type(shown).__name__ == "NoSuchInstance"
            # A walk passes it by.
            behind, _ = ask(agent, v2c.GetNextRequestPDU, (*name[:-1], 10))
            assert behind == (*name[:-1], 21)
    assert agent.counters.internal_errors == 0


def test_the_units_are_whole_numbers_without_a_hint(agent: SnmpAgent) -> None:
    """DISPLAY-HINT would have exporters show 13250 "volts": UNITS names the sub-unit instead."""
    described = columns(agent)["battery_voltage"][1]
    assert described.units == "millivolts"
    assert described.convention is None


@pytest.mark.parametrize("values", [{}, {"battery_voltage": math.nan}])
def test_quality_is_told_beside_it(agent: SnmpAgent, site: Site, values: dict[str, float]) -> None:
    """Why there is no value: the state of the device always answers, and so does the sensor's own status."""
    device = site.by_unit[11]
    device.snapshot = replace(device.snapshot, version=2, values=values)
    _, state = ask(agent, v2c.GetRequestPDU, (1, 3, 6, 1, 4, 1, 32473, 1, 1, 2, 1, 3, 1, 10, 11))
    assert int(state.getComponent().getComponent()) == 2  # online
    _, status = ask(agent, v2c.GetRequestPDU, (1, 3, 6, 1, 2, 1, 99, 1, 1, 1, 5, 11009))
    assert int(status.getComponent().getComponent()) in {2, 3}  # unavailable, nonoperational
