"""Who gets in when there is no room."""

from __future__ import annotations

from dataclasses import dataclass
from ipaddress import ip_network

import pytest

from gateway.core.ratelimit import ClientRate
from gateway.faces.modbus.admission import decide, rate_of
from gateway.faces.modbus.settings import ModbusSettings, RateSettings

NOW = 100.0


@dataclass(eq=False)
class Seat:
    peer: str
    seen: float
    idle: bool = True


SETTINGS = ModbusSettings(
    max_connections=4,
    max_per_client=2,
    allow=(ip_network("10.0.0.0/8"),),
    priority=(ip_network("10.9.0.0/16"),),
)


@dataclass(frozen=True)
class Case:
    name: str
    seats: list[Seat]
    peer: str
    refused: str | None = None
    leaves: int | None = None


def seats(*ages: tuple[str, float] | tuple[str, float, bool]) -> list[Seat]:
    return [Seat(age[0], NOW - age[1], age[2] if len(age) == 3 else True) for age in ages]


OLD = (("10.0.0.1", 50.0), ("10.0.0.2", 70.0), ("10.0.0.3", 60.0), ("10.9.0.1", 90.0))
BUSY = (("10.0.0.1", 1.0, False), ("10.0.0.2", 5.0, False), ("10.0.0.3", 3.0), ("10.9.0.1", 90.0))
ONLY_PRIORITY = (("10.9.0.1", 50.0), ("10.9.0.2", 60.0), ("10.9.0.3", 70.0), ("10.9.0.4", 80.0))
CASES = [
    Case("stranger", [], "192.0.2.1", "not_allowed"),
    Case("room", seats(*OLD[:3]), "10.0.0.9"),
    Case("full-the-longest-idle-leaves-but-no-priority", seats(*OLD), "10.0.0.9", leaves=1),
    Case("full-nobody-idle-long-enough", seats(*BUSY), "10.0.0.9", "full"),
    Case("full-only-priority", seats(*ONLY_PRIORITY), "10.0.0.9", "full"),
    Case("priority-takes-an-idle-one-first", seats(*BUSY), "10.9.0.2", leaves=2),
    Case("priority-takes-one-at-work-if-it-must", seats(*BUSY[:2], *BUSY[:2]), "10.9.0.2", leaves=1),
    Case("priority-does-not-displace-another-one", seats(*ONLY_PRIORITY), "10.9.0.5", "full"),
    Case("priority-makes-room-for-itself", seats(*ONLY_PRIORITY), "10.9.0.2", leaves=1),
    Case("own-limit", seats(("10.0.0.1", 5.0), ("10.0.0.1", 6.0)), "10.0.0.1", "client_full"),
    Case("own-limit-own-idle-one-leaves", seats(("10.0.0.1", 20.0), ("10.0.0.1", 30.0)), "10.0.0.1", leaves=1),
    Case("own-limit-is-no-matter-to-others", seats(("10.0.0.1", 5.0), ("10.0.0.1", 6.0)), "10.0.0.2"),
    Case("own-limit-priority", seats(("10.9.0.1", 5.0, False), ("10.9.0.1", 6.0, False)), "10.9.0.1", leaves=1),
]


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_admission(case: Case) -> None:
    verdict = decide(case.seats, case.peer, SETTINGS, NOW)
    assert verdict.refused == case.refused
    assert verdict.leaves is (None if case.leaves is None else case.seats[case.leaves])


def test_the_first_network_that_holds_a_client_decides() -> None:
    slow, fast = ClientRate(1.0, 1.0), ClientRate(9.0, 9.0)
    rates = RateSettings(networks=(((ip_network("10.1.0.0/16"),), slow), ((ip_network("10.0.0.0/8"),), fast)))
    assert rate_of("10.1.2.3", rates) is slow
    assert rate_of("10.2.2.3", rates) is fast
    assert rate_of("192.0.2.1", rates) is rates.client


def test_this_machine_reads_from_memory_without_a_limit_unless_it_is_named() -> None:
    assert rate_of("127.0.0.1", RateSettings()).requests_per_s == 0
    assert rate_of("::1", RateSettings()).line_per_s == ClientRate().line_per_s
