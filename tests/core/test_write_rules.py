"""Who may write what."""

from __future__ import annotations

from ipaddress import ip_network

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.core.site import Device
from gateway.core.write_request import SingleWrite
from gateway.core.write_rules import Range, Requester, WriteRule, WriteRules
from gateway.devices.model import Access, Space
from gateway.devices.schema import load_map

MAP = load_map("prostar-mppt")
DEVICE = Device("array-1", 11, 1, MAP)
EVERYBODY = (ip_network("0.0.0.0/0"), ip_network("::/0"))
EVERYTHING = (Range(0, 0xFFFF),)
SCADA = Requester("192.0.2.7")


def names(rule: WriteRule) -> set[str]:
    return {point.name for point in rule.allowed(MAP).values()}


def test_a_range_of_everything_allows_what_can_be_written_but_nothing_that_must_be_named() -> None:
    found = names(WriteRule(EVERYBODY, registers=EVERYTHING, coils=EVERYTHING))
    assert found == {p.name for p in MAP.points if p.access is not Access.READ and not p.named_only}
    assert found.isdisjoint({"factory_reset", "reset_control", "modbus_id", "meterbus_id", "clear_charge_total"})
    assert "lighting_test" not in found


@pytest.mark.parametrize("name", [p.name for p in MAP.points if p.named_only])
def test_what_must_be_named_is_allowed_by_its_name(name: str) -> None:
    assert names(WriteRule(EVERYBODY, points=frozenset({name}))) == {name}


@pytest.mark.parametrize("name", ["lighting_test", "battery_voltage", "nothing_of_that_name"])
def test_what_is_read_only_is_never_allowed(name: str) -> None:
    everything = WriteRule(EVERYBODY, points=frozenset({name}), registers=EVERYTHING, coils=EVERYTHING)
    assert name not in names(everything)


def test_registers_are_not_coils() -> None:
    assert names(WriteRule(EVERYBODY, registers=(Range(0, 2),))) == set()
    assert names(WriteRule(EVERYBODY, coils=(Range(0, 1),))) == {"equalize_triggered", "load_disconnect_forced"}


@pytest.mark.parametrize(
    ("rule", "requester", "holds"),
    [
        (WriteRule(), SCADA, False),
        (WriteRule((ip_network("192.0.2.0/24"),)), SCADA, True),
        (WriteRule((ip_network("192.0.2.0/24"),)), Requester("192.0.3.7"), False),
        (WriteRule((ip_network("192.0.2.0/24"),)), Requester("::ffff:192.0.2.7"), True),
        (WriteRule((ip_network("fe80::/10"),)), Requester("fe80::1%eth0"), True),
        (WriteRule(EVERYBODY), Requester(""), False),
        (WriteRule(()), SCADA, False),
        (WriteRule(roles=frozenset({"operator"})), SCADA, False),
        (WriteRule(roles=frozenset({"operator"})), Requester("192.0.2.7", "operator"), True),
        (WriteRule(roles=frozenset({"operator"})), Requester("192.0.2.7", "viewer"), False),
        (WriteRule((ip_network("10.0.0.0/8"),), frozenset({"operator"})), Requester("192.0.2.7", "operator"), False),
    ],
)
def test_for_whom_a_rule_holds(rule: WriteRule, requester: Requester, holds: bool) -> None:
    assert rule.holds_for(requester) is holds


def test_rules_are_for_their_units_and_add_up() -> None:
    rules = [
        WriteRule(EVERYBODY, unit_ids=frozenset({12}), registers=EVERYTHING),
        WriteRule((ip_network("192.0.2.7"),), registers=(Range(0xE000, 0xE000),)),
        WriteRule((ip_network("192.0.2.0/24"),), registers=(Range(0xE001, 0xE001),)),
    ]
    both = [SingleWrite(Space.REGISTERS, 0xE000, 1), SingleWrite(Space.REGISTERS, 0xE001, 1)]
    mine = WriteRules(rules, DEVICE)
    points = mine.points(SCADA, both)
    assert points is not None
    assert [point.name for point in points] == ["absorption_voltage", "float_voltage"]
    assert mine.points(Requester("192.0.2.8"), both) is None
    assert mine.any_for(Requester("192.0.2.8"))
    assert not mine.any_for(Requester("198.51.100.1"))
    assert mine
    assert not WriteRules(rules[:1], DEVICE)
    assert not WriteRules([], DEVICE)


@given(
    first=st.integers(0xDFF0, 0xE060),
    count=st.integers(1, 20),
    allowed=st.tuples(st.integers(0xE000, 0xE04F), st.integers(0, 30)),
)
def test_f42_a_request_is_allowed_only_when_all_of_it_is(first: int, count: int, allowed: tuple[int, int]) -> None:
    rule = WriteRule(EVERYBODY, registers=(Range(allowed[0], allowed[0] + allowed[1]),))
    writes = [SingleWrite(Space.REGISTERS, at, 0) for at in range(first, first + count)]
    each = [WriteRules([rule], DEVICE).points(SCADA, [write]) is not None for write in writes]
    assert (WriteRules([rule], DEVICE).points(SCADA, writes) is not None) is all(each)
    for write, yes in zip(writes, each, strict=True):
        point = MAP.writable_point(Space.REGISTERS, write.address)
        inside = allowed[0] <= write.address <= allowed[0] + allowed[1]
        assert yes is (inside and point is not None and not point.named_only)
