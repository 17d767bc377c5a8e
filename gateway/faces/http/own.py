"""The gateway's own metrics: what it is, what its lines (lines.py) and its faces did.

Each metric is one rule (rules.py). `OWN_METRICS` lists the descriptions for the documentation. Sources are
counters in memory; nothing here waits.
"""

from __future__ import annotations

import platform
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

from gateway import __version__
from gateway.core.clients import Client
from gateway.core.conditions import Conditions, DeviceConditions
from gateway.core.site import Site
from gateway.core.stats import HistoryStats, ModbusServerStats, NotifyStats, ServiceStats, TlsStats
from gateway.faces.http.clients import CLIENT_RULES, client_sources
from gateway.faces.http.conditions import (
    DEVICE_CONDITION_RULES,
    GATEWAY_CONDITION_RULES,
    NOTIFY_RULES,
    gateway_sources,
    receiver_source,
)
from gateway.faces.http.devices import DEVICE_LABELS, device_labels
from gateway.faces.http.history import DEVICE_HISTORY_RULES, STORE_RULES, DeviceHistoryView
from gateway.faces.http.lines import DEVICE_RULES, LINE_LABELS, LINE_RULES, LineView
from gateway.faces.http.metric import MetricInfo
from gateway.faces.http.rules import Rule, Source, each, families, gateway_counter, gateway_gauge, known, one
from gateway.faces.http.text import Lines


@dataclass(slots=True)
class HttpStats:
    """The HTTP face since start."""

    connections: int = 0
    closed_for_room: int = 0
    scrapes: int = 0
    scrape_s: float = 0.0
    abandoned: int = 0  # scrapes whose reply was not taken in time
    refused: int = 0  # requests without the right name, password or token
    failed: int = 0  # requests that met a mistake of ours


@dataclass(frozen=True, slots=True)
class GatewayView:
    """The process."""

    started_at: float  # wall clock
    ready: bool


GATEWAY_RULES: tuple[Rule[GatewayView], ...] = (
    Rule(
        gateway_gauge("build_info", "Version of the gateway and of Python, always 1.", "version", "python"),
        lambda _: (((__version__, platform.python_version()), 1.0),),
    ),
    one(gateway_gauge("start_time_seconds", "When the gateway started, Unix time."), lambda view: view.started_at),
    one(
        gateway_gauge("ready", "1 while everything that is configured listens, as /readyz says."),
        lambda view: view.ready,
    ),
)


@dataclass(frozen=True, slots=True)
class ServiceView:
    """What the process did, and the wall time at which its configuration was read."""

    stats: ServiceStats
    configured_at: float


SERVICE_RULES: tuple[Rule[ServiceView], ...] = (
    one(
        gateway_gauge(
            "config_last_reload_successful", "1 while the configuration that was last read is the one in use."
        ),
        lambda view: view.stats.reload_works,
    ),
    one(
        gateway_gauge(
            "config_last_reload_success_timestamp_seconds", "When the configuration in use was read, Unix time."
        ),
        lambda view: view.configured_at,
    ),
    each(
        gateway_counter("config_reloads", "Times that the configuration was read again, by outcome.", "outcome"),
        lambda view: dict.fromkeys(("applied", "refused"), 0) | view.stats.reloads,
    ),
    each(
        gateway_counter("task_restarts", "Times that a task died of a bug and was started again.", "task"),
        lambda view: view.stats.restarts,
    ),
    one(
        gateway_counter("log_lines_dropped", "Lines of the log that nobody took in time."),
        lambda view: view.stats.log.dropped,
    ),
)

MODBUS_RULES: tuple[Rule[ModbusServerStats], ...] = (
    one(gateway_gauge("modbus_connections", "Open Modbus TCP connections."), lambda stats: stats.open_connections),
    one(
        gateway_counter("modbus_connections_accepted", "Modbus TCP connections accepted."),
        lambda stats: stats.connections,
    ),
    one(
        gateway_counter("modbus_connections_refused", "Modbus TCP connections refused."),
        lambda stats: stats.refused_connections,
    ),
    one(gateway_counter("modbus_requests", "Modbus TCP requests."), lambda stats: stats.requests),
    one(
        gateway_counter("modbus_cache_hits", "Modbus TCP requests answered from memory."),
        lambda stats: stats.cache_hits,
    ),
    one(
        gateway_counter("modbus_forwarded", "Modbus TCP requests that were sent to a line."),
        lambda stats: stats.forwarded,
    ),
    each(
        gateway_counter("modbus_exceptions", "Exception replies to clients, by exception code (hexadecimal).", "code"),
        lambda stats: {f"{code:02X}": count for code, count in stats.exceptions.items()},
    ),
    each(
        gateway_counter("modbus_requests_refused", "Modbus TCP requests refused by policy, by reason.", "reason"),
        lambda stats: stats.refused,
    ),
    each(
        gateway_counter(
            "modbus_rate_limited",
            "Modbus TCP requests refused for a rate limit, by whose: client, client_line, device or line.",
            "limit",
        ),
        lambda stats: stats.limited,
    ),
    each(
        gateway_counter("modbus_writes", "Single writes that a rule allowed, by what became of them.", "outcome"),
        lambda stats: stats.writes,
    ),
    each(
        gateway_counter("modbus_connections_closed", "Modbus TCP connections the server ended, by reason.", "reason"),
        lambda stats: stats.closed,
    ),
    each(
        gateway_counter("modbus_malformed", "Input that is no Modbus TCP, by reason.", "reason"),
        lambda stats: stats.malformed,
    ),
)

TLS_RULES: tuple[Rule[TlsStats], ...] = (
    one(
        gateway_counter("modbus_tls_handshakes", "TLS handshakes of Modbus clients that were let in."),
        lambda stats: stats.handshakes,
    ),
    each(
        gateway_counter("modbus_tls_handshakes_refused", "TLS handshakes that failed, by reason.", "reason"),
        lambda stats: stats.refused,
    ),
    one(
        gateway_counter("modbus_tls_reload_failures", "Times that new certificate files could not be used."),
        lambda stats: stats.reload_failures,
    ),
    one(
        gateway_gauge("modbus_tls_files_in_use", "1 while the certificate files last read are those in use."),
        lambda stats: not stats.problem,
    ),
    known(
        gateway_gauge(
            "modbus_tls_certificate_expiry_timestamp_seconds", "When the server's certificate expires, Unix time."
        ),
        lambda stats: stats.not_after,
    ),
)

SNMP_RULES: tuple[Rule[Mapping[str, int]], ...] = (
    each(gateway_counter("snmp_events", "What the SNMP face counted, by event.", "event"), lambda stats: stats),
)

HTTP_RULES: tuple[Rule[HttpStats], ...] = (
    one(gateway_counter("http_connections_accepted", "HTTP connections accepted."), lambda stats: stats.connections),
    one(
        gateway_counter("http_connections_closed_for_room", "Idle HTTP connections closed to let another one in."),
        lambda stats: stats.closed_for_room,
    ),
    one(gateway_counter("http_refused", "HTTP requests without the right credentials."), lambda stats: stats.refused),
    one(gateway_counter("http_failed", "HTTP requests that met a mistake of the gateway."), lambda stats: stats.failed),
    one(
        gateway_counter("scrapes_abandoned", "Scrapes whose reply was not taken in time."),
        lambda stats: stats.abandoned,
    ),
    one(gateway_counter("scrapes", "Scrapes answered before this one."), lambda stats: stats.scrapes),
    one(
        gateway_counter("scrape_seconds", "Time from their requests to the last byte handed to the system."),
        lambda stats: stats.scrape_s,
    ),
)

OWN_METRICS: tuple[MetricInfo, ...] = tuple(
    rule.metric
    for rules in (
        GATEWAY_RULES,
        SERVICE_RULES,
        LINE_RULES,
        DEVICE_RULES,
        MODBUS_RULES,
        CLIENT_RULES,
        TLS_RULES,
        SNMP_RULES,
        HTTP_RULES,
        STORE_RULES,
        DEVICE_HISTORY_RULES,
        DEVICE_CONDITION_RULES,
        GATEWAY_CONDITION_RULES,
        NOTIFY_RULES,
    )
    for rule in rules
)
"""Every `prostar_gateway_*` metric; `process_*` and `python_gc_*` are in process.py."""


def _no_events() -> Mapping[str, int]:
    return {}


def _no_reasons() -> Sequence[str]:
    return ()


@dataclass(frozen=True, slots=True)
class Counts:
    """Where the counters of the faces are, and what keeps the gateway from being ready."""

    modbus: ModbusServerStats = field(default_factory=ModbusServerStats)
    snmp: Callable[[], Mapping[str, int]] = _no_events
    http: HttpStats = field(default_factory=HttpStats)
    not_ready: Callable[[], Sequence[str]] = _no_reasons
    history: HistoryStats | None = None  # None: no history is kept
    clients: Iterable[Client] = ()
    conditions: Conditions | None = None  # None: nobody watches them
    notifications: Sequence[NotifyStats] = ()
    service: ServiceStats | None = None  # None: nobody supervises it


class OwnMetrics:
    """The gateway's own metrics, each line and counter read once a scrape."""

    def __init__(self, site: Site, counts: Counts, began: float, wall: Callable[[float], float]) -> None:
        """`wall` gives the wall time of a monotonic moment, as `began` is one, by the clock as it is set now."""
        self._counts = counts
        self._began = began
        self._wall = wall
        self._lines = [Source.labelled(line, LINE_LABELS, (line.name, site.of_line(line.name))) for line in site.lines]
        self._devices = [Source.labelled(device, DEVICE_LABELS, device_labels(site, device)) for device in site.devices]

    def look(self, now: float) -> Iterator[None]:
        """Bring the conditions up to date; a step of the iteration is one device."""
        if self._counts.conditions is not None:
            for device in self._devices:
                self._counts.conditions.devices[device.of.unit_id].look(now)
                yield

    def families(self, now: float) -> Iterator[tuple[MetricInfo, Lines]]:
        """Each family that has samples, with its lines; conditions as they were at the last `look`."""
        counts = self._counts
        lines = [Source(LineView(line.of, line.of.status(now)), line.labels, line.written) for line in self._lines]
        yield from families(GATEWAY_RULES, [Source(GatewayView(self._wall(self._began), not counts.not_ready()))])
        if (service := counts.service) is not None:
            yield from families(SERVICE_RULES, [Source(ServiceView(service, self._wall(service.configured_at)))])
        yield from families(LINE_RULES, lines)
        yield from families(DEVICE_RULES, self._devices)
        yield from families(MODBUS_RULES, [Source(counts.modbus)])
        yield from families(CLIENT_RULES, client_sources(counts.clients, now))
        if counts.modbus.tls is not None:
            yield from families(TLS_RULES, [Source(counts.modbus.tls)])
        yield from families(SNMP_RULES, [Source(counts.snmp())])
        yield from families(HTTP_RULES, [Source(counts.http)])
        if counts.history is not None:
            yield from families(STORE_RULES, [Source(counts.history)])
            yield from families(DEVICE_HISTORY_RULES, self._histories(counts.history, now))
        if counts.conditions is not None:
            yield from families(DEVICE_CONDITION_RULES, self._conditions(counts.conditions))
            yield from families(GATEWAY_CONDITION_RULES, gateway_sources(counts.conditions))
        yield from families(NOTIFY_RULES, [receiver_source(stats) for stats in counts.notifications])

    def _conditions(self, conditions: Conditions) -> list[Source[DeviceConditions]]:
        return [
            Source(conditions.devices[device.of.unit_id], device.labels, device.written) for device in self._devices
        ]

    def _histories(self, history: HistoryStats, now: float) -> list[Source[DeviceHistoryView]]:
        return [
            Source(DeviceHistoryView(history.devices[device.of.unit_id], now), device.labels, device.written)
            for device in self._devices
            if device.of.unit_id in history.devices
        ]
