"""Is it still the same controller?"""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.core.identity import Identity, Kept
from gateway.devices.model import Growing

HOURS = Growing("hourmeter", 1.0, clearable=False)
CHARGE = Growing("charge_total", 60.0, clearable=True)
RULES = (HOURS, CHARGE)
KEPT = {  # half a day ago, read a minute ago
    "hourmeter": Kept((11985,), 940.0),
    "charge_total": Kept((4920.0, 322437120.0), 940.0),
}

KNOWN = Identity("PS-MPPT-40", "v01.01.13", None, {"hourmeter": 12000, "charge_total": 5000.0}, at=1000.0)


def later(seconds: float, hourmeter: float, charge: float, **more: str) -> Identity:
    return Identity(
        more.get("product", "PS-MPPT-40"),
        more.get("revision", "v01.01.13"),
        more.get("serial_number"),
        {"hourmeter": hourmeter, "charge_total": charge},
        at=1000.0 + seconds,
    )


def test_the_same_unit_a_minute_later() -> None:
    assert KNOWN.complaint(later(60, 12000, 5000.5), RULES) is None


@pytest.mark.parametrize(
    ("seen", "same"),
    [
        (later(3600, 11985, 4920.0), True),
        (later(3600, 11986, 4979.0), True),  # an hour at 60 A
        (later(3600, 11987, 5040.0), False),  # it cannot have run for so long
        (later(3600, 11986, 4919.0), False),
        (later(3600, 11986, 5045.0), False),
        (later(3600, 11985, 5000.0), False),  # the hours of one moment, the charge of another
        (later(3600, 12001, 4920.0), False),
        (later(3600, 12001, 5030.0), True),  # it had power all the time
        (later(3600, 11986, 0.0), True),  # and was cleared
        (later(3600, 11984, 4920.0), False),
    ],
)
def test_a_unit_that_had_no_power_goes_on_from_what_it_stored(seen: Identity, same: bool) -> None:
    known = replace(KNOWN, stored=KEPT)
    assert (known.complaint(seen, RULES) is None) is same
    if not same:
        assert known.complaint(seen, RULES) == KNOWN.complaint(seen, RULES)


def test_what_is_not_known_to_be_stored_has_to_fit_as_ever() -> None:
    known = replace(KNOWN, stored={"hourmeter": KEPT["hourmeter"]})
    assert known.complaint(later(60, 11985, 5000.0), RULES) is None
    assert known.complaint(later(60, 11985, 4920.0), RULES) is not None
    assert known.learned(Identity(at=9e9)).stored == known.stored


def test_what_was_told_of_its_memory_is_known_when_only_a_part_is_told_again() -> None:
    part = Identity(stored={"charge_total": Kept((4930.0,), 1060.0)})
    learned = replace(KNOWN, stored=KEPT).learned(part)
    assert learned.stored == {**KEPT, **part.stored}
    assert learned.complaint(later(120, 11985, 4930.0), RULES) is None


@pytest.mark.parametrize(
    ("seen", "word"),
    [
        (later(10, 12003, 5000.0), "hourmeter"),
        (later(10, 11999, 5000.0), "hourmeter"),
        (later(10, 12000, 5400.0), "charge_total"),
        (later(10, 12000, 4990.0), "charge_total"),
        (later(10, 12000, 5000.0, product="PS-MPPT-25"), "product"),
        (later(10, 12000, 5000.0, revision="v01.01.14"), "revision"),
    ],
)
def test_another_unit_is_told_by_what_differs(seen: Identity, word: str) -> None:
    complaint = KNOWN.complaint(seen, RULES)
    assert complaint is not None
    assert complaint.startswith(word)


def test_a_cleared_counter_is_no_other_unit() -> None:
    assert KNOWN.complaint(later(10, 12000, 0.0), RULES) is None


def test_a_configured_serial_number_decides_from_the_first_look() -> None:
    configured = Identity(serial_number="17150342")
    assert configured.complaint(later(0, 7, 1.0, serial_number="17150342"), RULES) is None
    complaint = configured.complaint(later(0, 7, 1.0, serial_number="17150343"), RULES)
    assert complaint == "serial number is 17150343, expected 17150342"


def test_what_a_unit_does_not_tell_is_not_compared() -> None:
    assert Identity(serial_number="17150342").complaint(Identity(), RULES) is None
    assert Identity().complaint(later(0, 1, 1.0), RULES) is None


def test_what_was_configured_is_never_unlearned() -> None:
    learned = Identity(product="PS-MPPT-40", serial_number="1").learned(later(0, 5, 6.0))
    assert learned.serial_number == "1"
    assert learned.counters == {"hourmeter": 5, "charge_total": 6.0}
    assert learned.learned(Identity(at=9e9)).at == learned.at


@given(st.floats(0, 86400), st.floats(0, 1e7), st.floats(0, 1), st.floats(0, 1), st.floats(0, 1))
def test_it_is_itself_too_when_it_lost_its_power_whenever_it_stored_last(
    stored_s: float, outage_s: float, written: float, ran: float, sun: float
) -> None:
    """What it goes on from was written at some time between our last look at it and the last of its power."""
    at = 1000.0 - stored_s
    known = replace(KNOWN, stored={"hourmeter": Kept((11990,), at), "charge_total": Kept((4900.0,), at)})
    hours, ran_h = stored_s / 3600, ran * outage_s / 3600
    meter, charge = 11990 + int(written * hours), 4900 + 60 * written * hours * sun
    assert known.complaint(later(outage_s, meter + int(ran_h), charge + 60 * ran_h * sun), RULES) is None


@given(st.floats(0, 1e7), st.floats(0, 1), st.floats(0, 1))
def test_a_unit_is_always_itself_whatever_the_outage(outage_s: float, ran: float, sun: float) -> None:
    """However long it was away, and however much of that it ran and charged."""
    hours = outage_s / 3600
    assert KNOWN.complaint(later(outage_s, 12000 + int(hours * ran), 5000 + 60 * hours * sun), RULES) is None
