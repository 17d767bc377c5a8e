"""The gateway's own counters as metrics."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator

import pytest

from gateway import __version__
from gateway.core.clients import ClientTable
from gateway.core.conditions import HISTORY_DOWN, Conditions
from gateway.core.ratelimit import ClientRate
from gateway.core.site import LineState, Site
from gateway.core.stats import (
    DeviceHistoryStats,
    HistoryStats,
    ModbusServerStats,
    NotifyStats,
    ServiceStats,
    TlsStats,
)
from gateway.faces.http.exposition import Exposition
from gateway.faces.http.lines import ERROR_KINDS
from gateway.faces.http.metric import MetricInfo, MetricKind
from gateway.faces.http.own import OWN_METRICS, Counts, HttpStats
from gateway.modbus.counters import UpstreamCounters
from tests.faces.http.scrapes import parse, scrape

from .conftest import ManualClock, UnreadableLine


def sample(site: Site, clock: ManualClock, counts: Counts, name: str, **labels: str) -> float:
    """The one sample of that name and (at least) those labels."""
    [value] = [
        sample.value
        for family in parse(scrape(Exposition(site, clock, counts)))
        for sample in family.samples
        if sample.name == name and labels.items() <= sample.labels.items()
    ]
    return float(value)


def test_line_counters(site: Site, clock: ManualClock) -> None:
    line = site.lines[0]
    assert isinstance(line, UnreadableLine)
    line.stats.sent = 10
    line.stats.ok = 7
    line.stats.failed.update(timeout=2, offline=1)
    line.stats.wire.noise_bytes = 5
    line.stats.wire.echoes = 3
    line.state = LineState.DOWN

    def of_line(name: str, **labels: str) -> float:
        return sample(site, clock, Counts(), f"prostar_gateway_line_{name}", line="shelter-a", **labels)

    assert of_line("up") == 0
    assert of_line("use_ratio") == 0.25
    assert of_line("queue_depth") == 2
    assert of_line("requests_total") == 10
    assert of_line("replies_total") == 7
    assert {kind: of_line("errors_total", kind=kind) for kind in (*ERROR_KINDS, "offline")} == {
        "timeout": 2,
        "crc": 0,
        "mismatch": 0,
        "exception": 0,
        "offline": 1,
    }
    assert of_line("discarded_bytes_total", kind="noise") == 5
    assert of_line("discarded_frames_total", kind="echo") == 3
    assert sample(site, clock, Counts(), "prostar_gateway_line_up", line="shelter-b") == 1


def test_device_counters(site: Site, clock: ManualClock) -> None:
    site.devices[1].stats.polls = 4
    site.devices[1].stats.implausible = 2
    for name, value in (("polls", 4), ("implausible", 2), ("offline", 0)):
        assert sample(site, clock, Counts(), f"prostar_gateway_device_{name}_total", unit_id="12") == value


def test_face_counters(site: Site, clock: ManualClock) -> None:
    modbus = ModbusServerStats(connections=3, open_connections=2, requests=9)
    modbus.exceptions[0x0B] = 4
    modbus.malformed["length"] = 1
    counts = Counts(modbus, lambda: {"bad_community": 6}, HttpStats(scrapes=5, scrape_s=0.5))
    for name, labels, value in (
        ("modbus_connections", {}, 2),
        ("modbus_connections_accepted_total", {}, 3),
        ("modbus_requests_total", {}, 9),
        ("modbus_exceptions_total", {"code": "0B"}, 4),
        ("modbus_malformed_total", {"reason": "length"}, 1),
        ("snmp_events_total", {"event": "bad_community"}, 6),
        ("scrapes_total", {}, 5),
        ("scrape_seconds_total", {}, 0.5),
    ):
        assert sample(site, clock, counts, f"prostar_gateway_{name}", **labels) == value


def test_version_and_start(site: Site, clock: ManualClock) -> None:
    exposition = Exposition(site, clock, Counts())
    clock.date += 60
    found = {sample.name: sample for family in parse(scrape(exposition)) for sample in family.samples}
    assert found["prostar_gateway_build_info"].labels["version"] == __version__
    assert found["prostar_gateway_start_time_seconds"].value == clock.date - 60


def test_a_clock_that_is_set_later_moves_the_moments_that_it_told(site: Site, clock: ManualClock) -> None:
    """A machine without a clock of its own starts in 1970: the configuration was not read then."""
    exposition = Exposition(site, clock, Counts(service=ServiceStats(configured_at=clock.now)))
    name = "prostar_gateway_config_last_reload_success_timestamp_seconds"
    for step_s in (0.0, 1.8e9, 3600.0):
        clock.date += step_s
        found = {sample.name: sample for family in parse(scrape(exposition)) for sample in family.samples}
        assert found[name].value == pytest.approx(clock.date)
        assert found["prostar_gateway_start_time_seconds"].value == pytest.approx(clock.date)


def test_what_is_collected_is_what_is_described(site: Site, clock: ManualClock) -> None:
    modbus = ModbusServerStats(tls=TlsStats(1, Counter(timeout=1), not_after=2e9))
    modbus.exceptions[2] = 1
    for reasons in (modbus.malformed, modbus.refused, modbus.limited, modbus.writes, modbus.closed):
        reasons["because"] = 1
    line, device = site.lines[0], site.devices[0]
    line.stats.seconds_by_client["10.0.0.1"] = 1.0
    device.stats.refresh_s = 1.0
    line.stats.upstream = UpstreamCounters()
    of_device = DeviceHistoryStats(2, Counter(refused=1), days=256, apart=1, harvested_at=clock.now)
    history = HistoryStats({11: of_device}, store_up=True, store_errors=Counter(full=1))
    clients = ClientTable(modbus, burst_s=2.0)
    clients.arrived("10.0.0.1", ClientRate(), clock.now).exceptions[2] = 1
    conditions = Conditions(site, (HISTORY_DOWN,), clock.now)
    conditions.gateway.tell(HISTORY_DOWN, raised=True, now=clock.now)
    notifications = [NotifyStats("192.0.2.7:162", "inform", refused=Counter(user=1))]
    exposition = Exposition(
        site,
        clock,
        Counts(
            modbus,
            lambda: {"get": 1},
            history=history,
            clients=clients,
            conditions=conditions,
            notifications=notifications,
            service=ServiceStats(restarts=Counter(history=1)),
        ),
    )

    def collected() -> Iterator[tuple[str, str, str, set[str]]]:
        for family in parse(scrape(exposition)):
            if family.name.startswith("prostar_gateway"):
                labels = {frozenset(sample.labels.keys() - {"le"}) for sample in family.samples}
                assert len(labels) == 1, f"{family.name} has samples with differing labels, or none"
                total = "_total" if family.type == "counter" else ""
                yield family.name + total, family.type, family.documentation, set(labels.pop())

    assert list(collected()) == [(info.name, info.kind.value, info.help, set(info.labels)) for info in OWN_METRICS]


def test_where_the_time_of_a_line_goes(site: Site, clock: ManualClock) -> None:
    stats = site.lines[0].stats
    stats.seconds_by_purpose["poll"] = 12.5
    stats.seconds_by_client["10.0.0.1"] = 0.5
    stats.queue_wait.observe(0.02)
    site.devices[0].stats.errors["crc"] = 3
    for name, labels, value in (
        ("line_purpose_seconds_total", {"line": "shelter-a", "purpose": "poll"}, 12.5),
        ("line_purpose_seconds_total", {"line": "shelter-a", "purpose": "write"}, 0),
        ("line_client_seconds_total", {"client": "10.0.0.1"}, 0.5),
        ("line_queue_wait_seconds_bucket", {"line": "shelter-a", "le": "0.025"}, 1),
        ("line_queue_wait_seconds_bucket", {"line": "shelter-a", "le": "0.01"}, 0),
        ("line_queue_wait_seconds_count", {"line": "shelter-a"}, 1),
        ("line_stretch_ratio", {"line": "shelter-a"}, 1),
        ("line_echo", {"line": "shelter-a"}, 0),
        ("device_errors_total", {"device": "array-1", "kind": "crc"}, 3),
        ("device_errors_total", {"device": "array-2", "kind": "timeout"}, 0),
    ):
        assert sample(site, clock, Counts(), f"prostar_gateway_{name}", **labels) == value


def test_ready_is_what_readyz_says(site: Site, clock: ManualClock) -> None:
    assert sample(site, clock, Counts(), "prostar_gateway_ready") == 1
    assert sample(site, clock, Counts(not_ready=lambda: ["no port"]), "prostar_gateway_ready") == 0


@pytest.mark.parametrize("info", OWN_METRICS, ids=lambda info: info.name)
def test_descriptions_are_fit_to_be_documented(info: MetricInfo) -> None:
    assert re.fullmatch(r"prostar_gateway(_[a-z]+)+", info.name)
    assert info.name.endswith("_total") == (info.kind is MetricKind.COUNTER)
    assert info.help.endswith(".")
