from __future__ import annotations

from dataclasses import replace

import pytest

from gateway.devices import agreement
from gateway.devices.agreement import all_maps, disagreements, map_of_product
from gateway.devices.model import Bit, DeviceMap, Kind, Point
from gateway.devices.schema import load_map, models
from gateway.errors import MapError

PROSTAR, TRISTAR = load_map("prostar-mppt"), load_map("tristar-mppt")


def changed(name: str, **changes: object) -> DeviceMap:
    """The TriStar's map with one point changed."""
    points = tuple(
        replace(point, **changes) if point.name == name else point  # type: ignore[arg-type]  # replace checks the names
        for point in TRISTAR.points
    )
    return replace(TRISTAR, points=points)


def test_the_maps_agree() -> None:
    assert [device_map.model for device_map in all_maps()] == list(models())
    assert disagreements(all_maps()) == []


def test_most_of_what_is_measured_has_one_name_on_both() -> None:
    shared = {point.name for point in PROSTAR.points} & {point.name for point in TRISTAR.points}
    assert {"battery_voltage", "array_voltage", "charge_current", "charge_power", "charge_state", "alarms"} <= shared
    assert {"array_faults", "charge_total", "hourmeter", "charge_today", "absorption_voltage", "clear_faults"} <= shared
    assert len(shared) > 75


def point(name: str) -> Point:
    return TRISTAR.point(name)


@pytest.mark.parametrize(
    ("name", "changes", "said"),
    [
        ("battery_voltage", {"unit": "A"}, "point battery_voltage: unit is A, on prostar-mppt it is V"),
        ("charge_power", {"group": point("charge_today").group}, "point charge_power: group is today, on"),
        ("charge_total", {"metric": "morningstar_charge"}, "point charge_total: metric is morningstar_charge, on"),
        ("hourmeter", {"metric_scale": 1.0}, "point hourmeter: metric_scale is 1.0, on prostar-mppt it is 3600.0"),
        ("charge_state", {"enumeration": None}, "point charge_state: kind is number, on prostar-mppt it is enum"),
        ("array_faults", {"mib": None}, "point array_faults: MIB column is None, on"),
        ("sweep_voc", {"mib": replace(point("sweep_voc").mib, column=99)}, "sweep_voc: MIB column is 99, on"),  # type: ignore[type-var]  # it has one
        ("sweep_voc", {"mib": replace(point("sweep_voc").mib, scale=1)}, "sweep_voc: MIB scale is 1, on"),  # type: ignore[type-var]  # it has one
    ],
)
def test_a_point_that_means_something_else_is_named(name: str, changes: dict[str, object], said: str) -> None:
    found = disagreements([PROSTAR, changed(name, **changes)])
    assert any(said in problem for problem in found), found


def test_a_column_may_differ_only_where_the_map_says_so() -> None:
    faults = TRISTAR.point("array_faults")
    assert faults.mib is not None
    assert faults.mib.named == "tristar_faults"
    found = disagreements([PROSTAR, changed("array_faults", mib=replace(faults.mib, named=None))])
    assert found == ["tristar-mppt: point array_faults: MIB column is 52, on prostar-mppt it is 25"]


def test_a_label_stands_for_one_number_of_a_table_and_has_one_severity() -> None:
    switches = (Bit(0, "switch_8", "", "info"),)
    other = replace(TRISTAR, bit_tables={**TRISTAR.bit_tables, "dip_switches": switches})
    assert disagreements([PROSTAR, other]) == [
        "tristar-mppt: dip_switches 0 is switch_8, on prostar-mppt it is switch_1"
    ]
    alarms = (Bit(0, "rts_open", "", "critical"),)
    other = replace(TRISTAR, bit_tables={**TRISTAR.bit_tables, "tristar_alarms": alarms})
    (of_now, *rest) = disagreements([PROSTAR, other])
    assert of_now == "tristar-mppt: rts_open of alarms is critical, on prostar-mppt it is warning"
    assert [problem.split()[3] for problem in rest] == ["alarms_today"]


def test_a_product_belongs_to_one_model() -> None:
    greedy = replace(TRISTAR, identity=replace(TRISTAR.identity, product_prefixes=("PS-",)))
    assert disagreements([PROSTAR, greedy]) == [
        f"prostar-mppt: product {product} is also claimed by tristar-mppt" for product in PROSTAR.identity.product_codes
    ]


@pytest.mark.parametrize(
    ("product", "model"),
    [
        ("PS-MPPT-25", "prostar-mppt"),
        ("PS-MPPT-40M", "prostar-mppt"),
        ("PS-MPPT-60X", "prostar-mppt"),
        ("TS-MPPT-45", "tristar-mppt"),
        ("TS-MPPT-60", "tristar-mppt"),
        ("TS-MPPT-60-600V", None),
        ("TS-60", None),
        ("", None),
    ],
)
def test_a_unit_is_known_by_its_product(product: str, model: str | None) -> None:
    found = map_of_product(product)
    assert (None if found is None else found.model) == model


def test_maps_that_disagree_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    maps = {"prostar-mppt": PROSTAR, "tristar-mppt": changed("battery_voltage", unit="A")}
    monkeypatch.setattr(agreement, "load_map", maps.__getitem__)
    with pytest.raises(MapError, match="unit is A"):
        all_maps.__wrapped__()


def test_texts_are_of_one_kind_everywhere() -> None:
    assert {each.kind for each in TRISTAR.points} == set(Kind)
